"""The registry of rivals: the published predictors and rules that Offboard is compared with, by short name.

A robot knows them only by the path of their class, as it knows the classes of a user.
"""

from offboard.common.class_path import MODULE_CLASS
from offboard.common.errors import ConfigError
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies.objectives import OBJECTIVES
from offboard.robot_client.predictors import Model, Predictor

_HOME = "offboard.loadgen.rivals"
_RIVER = "river:"  # before the package and class of a regressor of river
_PREDICTORS = {
    "recursive-least-squares": "recursive.RecursiveLeastSquares",
    "clipped-least-squares": "adaptive.ClippedLeastSquares",
    "bayesian-least-squares": "adaptive.BayesianLeastSquares",
    "theil-sen": "robust.TheilSen",
    "huber": "robust.Huber",
    "k-means": "k_means.KMeansOfSizes",
    "random-forest": "random_forest.RandomForest",
    "arima": "arima.Arima",
    "sarima": "arima.Sarima",
    "lstm": "lstm.Lstm",
    "lstm-sequence": "lstm.LstmSequence",
}
_SLOW = ("random-forest", "arima", "sarima", "lstm", "lstm-sequence")
_RULES = {"linucb": "bandits.LinUcb", "thompson": "bandits.Thompson"}

PREDICTORS = (*predictors.names(), *_PREDICTORS)
PREDICTOR_HELP = f"{predictors.HELP}; for comparison: {', '.join(_PREDICTORS)}, {_RIVER}{MODULE_CLASS}"
RULES = (*policies.names(), *_RULES)
POLICY_HELP = f"{policies.HELP}; for comparison: {', '.join(_RULES)}"


def predictor(name: str, where: str = "predictor") -> str:
    """The name of this predictor for a robot; ConfigError unless there is one. `where` names its flag."""
    if name in _PREDICTORS:
        return f"{_HOME}.{_PREDICTORS[name]}"
    if name.startswith(_RIVER) and "." in name:
        return f"{_HOME}.river_model.{name.removeprefix(_RIVER).replace('.', '__')}"
    predictors.check_name(name, where, PREDICTOR_HELP)
    return name


def policy(name: str, where: str = "policy") -> str:
    """The name of this policy for a robot; ConfigError unless there is one. `where` names its flag."""
    wrappers, colon, rule = name.rpartition(":")
    known = f"{wrappers}{colon}{_HOME}.{_RULES[rule]}" if rule in _RULES else name
    policies.check_name(known, where, POLICY_HELP)
    return known


def split_objective(name: str, where: str) -> tuple[str, str | None]:
    """The policy and the objective of POLICY or POLICY+OBJECTIVE; None: no objective is named.

    ConfigError if the policy weighs no costs; `where` names the flag or the key.
    """
    chosen, plus, objective = name.partition("+")
    if not plus:
        return chosen, None
    if objective not in OBJECTIVES:
        raise ConfigError(f"{where}: {name!r}: {objective!r} is not one of {', '.join(OBJECTIVES)}")
    if not policies.weighs_cost(policy(chosen, where)):
        raise ConfigError(f"{where}: {name!r}: an objective changes nothing with {chosen}")
    return chosen, objective


def make(name: str, window: int, seed: int = 0) -> Predictor | Model:
    """A new predictor; MissingExtra if its library is not installed."""
    return predictors.make(predictor(name), window, seed)


def slow(name: str) -> bool:
    """Whether one fit of this predictor takes tenths of a second or more."""
    return name in _SLOW
