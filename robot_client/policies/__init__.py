"""The registry of policies, by name; and the names that a policy is written with.

A policy is named by its rule, with wrappers in front: `hedge:probe:greedy`. `default` stands for that name.
A rule of a user is named by the path of its class. Rules and wrappers are loaded when they are first made:
`--help` only lists their names.
"""

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from offboard.common.config import MODULE_CLASS, find_class
from offboard.common.errors import ConfigError
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

if TYPE_CHECKING:
    from offboard.robot_client.policies.decision import ALONE, BOTH, PINNED, Decision, Hedge, Policy, Probe
    from offboard.robot_client.policies.forecast import Forecast, Outlook

__all__ = [
    "ALONE",
    "BOTH",
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
    "full_name",
    "make",
    "names",
    "predictor_of",
    "weighs_cost",
]

DEFAULT = "hedge:probe:greedy"
ALIAS = "default"


@dataclass(frozen=True, slots=True)
class _Rule:
    """Where a rule is, and what it is made with.

    `home`: its file and class. `arguments`: those of the class.
    `predictor`: the name of the predictor that the rule is meant for.
    `heartbeats`: whether the rule is meant for sites that send heartbeats.
    `weighs_cost`: whether an objective other than the expected time changes its decisions.
    """

    home: str
    arguments: tuple[str, ...] = ()
    predictor: str = "least-squares"
    heartbeats: bool = True
    weighs_cost: bool = True


_RULES: dict[str, _Rule] = {
    "paper": _Rule("baselines.Paper", weighs_cost=False, heartbeats=False),
    "paper-with-heartbeats": _Rule("baselines.Paper", weighs_cost=False),
    ONBOARD: _Rule("baselines.Always", (ONBOARD,), predictor="parts", weighs_cost=False, heartbeats=False),
    CLOUD: _Rule("baselines.Always", (CLOUD,), predictor="parts", weighs_cost=False, heartbeats=False),
    "greedy": _Rule("greedy.Greedy", predictor="parts"),
}
_OWN = _Rule("", predictor="parts")  # a class of a user
_WRAPPERS: dict[str, str] = {
    "probe": "probe.WithProbes",
    "hedge": "hedge.WithHedges",
    "budget": "budget.WithBudget",
}
HELP = (
    f"{', '.join(_RULES)}, {ALIAS} ({DEFAULT}), or {MODULE_CLASS} of your own; "
    f"any of {', '.join(_WRAPPERS)} may go in front"
)


def __getattr__(name: str) -> Any:
    """The names that a policy is written with are loaded when they are first used (PEP 562)."""
    if name not in __all__:
        raise AttributeError(name)
    return _load(f"{'forecast' if name in ('Forecast', 'Outlook') else 'decision'}.{name}")


def make(name: str, seed: int = 0) -> "Policy":
    """The policy of this name; policies with the same seed draw the same numbers."""
    check_name(name)
    *wrappers, last = full_name(name).split(":")
    policy: Policy
    if last in _RULES:
        policy = _load(_RULES[last].home)(*_RULES[last].arguments)
    else:
        policy = find_class(last, "policy")(seed=seed)
    for wrapper in reversed(wrappers):
        policy = _load(_WRAPPERS[wrapper])(policy)
    return policy


def full_name(name: str) -> str:
    """The same name with `default` written out."""
    wrappers, colon, rule = name.rpartition(":")
    return f"{wrappers}{colon}{DEFAULT}" if rule == ALIAS else name


def predictor_of(name: str) -> str:
    """The name of the predictor that a policy is meant for; a class of a user says it in `predictor`."""
    rule = _rule(name)
    if rule is not _OWN:
        return rule.predictor
    found: str = getattr(find_class(name.rpartition(":")[2], "policy"), "predictor", rule.predictor)
    return found


def heartbeats(name: str) -> bool:
    """Whether this policy is meant for sites that send heartbeats."""
    return _rule(name).heartbeats


def weighs_cost(name: str) -> bool:
    """Whether an objective other than the expected time changes the decisions of this policy."""
    return _rule(name).weighs_cost


def names() -> tuple[str, ...]:
    """The rules, without wrappers."""
    return tuple(_RULES)


def check_name(name: str, where: str = "policy") -> None:
    """ConfigError unless all parts of the name are known or a path; `where` names its flag or field."""
    *wrappers, rule = full_name(name).split(":")
    if rule not in _RULES and "." not in rule:
        raise ConfigError(f"{where}: {name!r} is not one of {HELP}")
    for n, wrapper in enumerate(wrappers):
        if wrapper not in _WRAPPERS or wrapper in wrappers[:n]:
            known = ", ".join(_WRAPPERS)
            raise ConfigError(f"{where}: {name!r}: {wrapper!r} is not one of {known}, once each")


def _rule(name: str) -> _Rule:
    """The rule of a policy."""
    return _RULES.get(full_name(name).rpartition(":")[2], _OWN)


def _load(home: str) -> Any:
    module, _, name = home.partition(".")
    return getattr(importlib.import_module(f"offboard.robot_client.policies.{module}"), name)
