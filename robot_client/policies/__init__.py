"""Where a task should run: rules from a forecast to a decision, no clock, no socket; chance from a seed.

A policy is named by its rule, with any wrappers before it: `hedge:probe:greedy`.
What the decision leads to is in `offloader`.
"""

import importlib
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING, Any

from offboard.common.errors import ConfigError

if TYPE_CHECKING:
    from offboard.robot_client.policies.decision import PINNED, Decision, Hedge, Policy, Probe
    from offboard.robot_client.policies.forecast import Forecast, Outlook

__all__ = [
    "DEFAULT",
    "HELP",
    "PINNED",
    "Decision",
    "Forecast",
    "Hedge",
    "Outlook",
    "Policy",
    "Probe",
    "check_name",
    "make",
    "names",
    "predictor_of",
    "weighs_cost",
]

DEFAULT = "hedge:probe:greedy"


@dataclass(frozen=True, slots=True)
class _Rule:
    """The predictor that a rule is meant with; how it is made is in `rules`."""

    predictor: str = "least-squares"
    weighs_cost: bool = True  # else no objective changes what it does


# Names only, so that --help, which lists them, need not load what they stand for.
_RULES: dict[str, _Rule] = {
    "paper": _Rule(weighs_cost=False),
    "onboard": _Rule(weighs_cost=False),
    "cloud": _Rule(weighs_cost=False),
    "greedy": _Rule("work:average"),
    "hysteresis": _Rule(),
    "epsilon": _Rule(),
    "linucb": _Rule("bayesian-least-squares"),
    "thompson": _Rule("bayesian-least-squares"),
}
_WRAPPERS = ("probe", "hedge", "breaker", "budget")
HELP = f"{', '.join(_RULES)}; any of {', '.join(_WRAPPERS)} go around it: {DEFAULT}"


def __getattr__(name: str) -> Any:
    """What a policy is written with; loaded where it is first asked for."""
    if name not in __all__:
        raise AttributeError(name)
    home = "forecast" if name in ("Forecast", "Outlook") else "decision"
    return getattr(importlib.import_module(f"offboard.robot_client.policies.{home}"), name)


def make(name: str, seed: int = 0) -> "Policy":
    """The policy of this name; the same seed draws the same."""
    from offboard.robot_client.policies.rules import RULES
    from offboard.robot_client.policies.wrappers import WRAPPERS

    check_name(name)
    *wrappers, rule = name.split(":")
    policy = RULES[rule](Random(seed))
    for wrapper in reversed(wrappers):
        policy = WRAPPERS[wrapper](policy)
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
