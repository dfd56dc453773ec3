"""The registry of rivals: the published predictors that Offboard is compared with, by short name.

A robot knows them only by the path of their class, as it knows the classes of a user.
"""

from offboard.common.errors import MissingExtra
from offboard.robot_client import predictors
from offboard.robot_client.predictors import Model, Predictor
from offboard.robot_client.predictors.window import WINDOW

_HOME = "offboard.loadgen.rivals"
_PREDICTORS = {
    "k-means": "k_means.KMeansOfSizes",
    "random-forest": "random_forest.RandomForest",
    "arima": "arima.Arima",
    "lstm": "lstm.Lstm",
    "lstm-sequence": "lstm.LstmSequence",
}
_SLOW = ("random-forest", "arima", "lstm", "lstm-sequence")

PREDICTORS = (*predictors.names(), *_PREDICTORS)
PREDICTOR_HELP = f"{predictors.HELP}; for comparison: {', '.join(_PREDICTORS)}"


def predictor(name: str, where: str = "predictor") -> str:
    """The name of this predictor for a robot; ConfigError unless there is one. `where` names its flag."""
    if name in _PREDICTORS:
        return f"{_HOME}.{_PREDICTORS[name]}"
    predictors.check_name(name, where, PREDICTOR_HELP)
    return name


def make(name: str, window: int, seed: int = 0) -> Predictor | Model:
    """A new predictor; MissingExtra if its library is not installed."""
    return predictors.make(predictor(name), window, seed)


def takes_several_numbers(name: str) -> bool:
    """Whether this predictor uses all numbers of a size, and not only the first one."""
    try:
        return bool(getattr(make(name, WINDOW), "several_numbers", False))
    except MissingExtra:
        return False


def slow(name: str) -> bool:
    """Whether one fit of this predictor takes tenths of a second or more."""
    return name in _SLOW
