"""Where a task should run: rules from a forecast to a decision, no clock, no socket; chance from a seed.

A policy is named by its rule, with any wrappers before it: `hedge:probe:greedy`.
What the decision leads to is in `offloader`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from common.errors import ConfigError
from robot_client.policies.base import PINNED, Decision, Forecast, Outlook, Policy
from robot_client.policies.rules import Always, Epsilon, Greedy, Hysteresis, LinUcb, Paper, Thompson
from robot_client.policies.wrappers import Breaker, Budget, Hedge, Probe
from robot_client.runner import CLOUD, ONBOARD

__all__ = [
    "DEFAULT",
    "HELP",
    "PINNED",
    "Decision",
    "Forecast",
    "Outlook",
    "Policy",
    "check_name",
    "make",
    "names",
    "predictor_of",
    "weighs_cost",
]

DEFAULT = "hedge:probe:greedy"


@dataclass(frozen=True, slots=True)
class _Rule:
    """How a rule is made, and the predictor that it is meant with."""

    make: Callable[[Random], Policy]
    predictor: str = "least-squares"
    weighs_cost: bool = True  # else no objective changes what it does


_RULES: dict[str, _Rule] = {
    "paper": _Rule(lambda _: Paper(), weighs_cost=False),
    ONBOARD: _Rule(lambda _: Always(ONBOARD), weighs_cost=False),
    CLOUD: _Rule(lambda _: Always(CLOUD), weighs_cost=False),
    "greedy": _Rule(lambda _: Greedy(), "work:average"),
    "hysteresis": _Rule(lambda _: Hysteresis()),
    "epsilon": _Rule(Epsilon),
    "linucb": _Rule(lambda _: LinUcb(), "bayesian-least-squares"),
    "thompson": _Rule(Thompson, "bayesian-least-squares"),
}
_WRAPPERS: dict[str, Callable[[Policy], Policy]] = {
    "probe": Probe,
    "hedge": Hedge,
    "breaker": Breaker,
    "budget": Budget,
}
HELP = f"{', '.join(_RULES)}; any of {', '.join(_WRAPPERS)} go around it: {DEFAULT}"


def make(name: str, seed: int = 0) -> Policy:
    """The policy of this name; the same seed draws the same."""
    check_name(name)
    *wrappers, rule = name.split(":")
    policy = _RULES[rule].make(Random(seed))
    for wrapper in reversed(wrappers):
        policy = _WRAPPERS[wrapper](policy)
    return policy


def predictor_of(name: str) -> str:
    """The name of the predictor that a policy is meant with."""
    return _RULES[name.rpartition(":")[2]].predictor


def weighs_cost(name: str) -> bool:
    """Whether an objective other than the expected time changes what it decides."""
    return _RULES[name.rpartition(":")[2]].weighs_cost


def names() -> tuple[str, ...]:
    """The rules by themselves."""
    return tuple(_RULES)


def check_name(name: str, where: str = "policy") -> None:
    """ConfigError, naming `where` it stood, unless `make` knows it."""
    *wrappers, rule = name.split(":")
    if rule not in _RULES:
        raise ConfigError(f"{where}: {name!r} is not one of {HELP}")
    for n, wrapper in enumerate(wrappers):
        if wrapper not in _WRAPPERS or wrapper in wrappers[:n]:
            raise ConfigError(
                f"{where}: {name!r}: {wrapper!r} is not one of {', '.join(_WRAPPERS)}, once each"
            )
