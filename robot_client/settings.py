"""The options of `Offloader.connect` that few robots need, and of how a robot decides, with help and limits.

The common options are keywords of `Offloader.connect` itself. Flags, scenarios, the ROS 2 node and summaries
of runs read those of how a robot decides.
"""

import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.common.task_states import TaskStates
from offboard.robot_client import policies, predictors
from offboard.robot_client.discovery.roster import KNOWN_MAX
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.store import Store
from offboard.robot_client.policies import Policy, objectives
from offboard.robot_client.policies.allowance import DUPLICATES, Allowance
from offboard.robot_client.policies.decision import Named
from offboard.robot_client.policies.objectives import MEAN, OBJECTIVE, S_PER_QUALITY, Energy, Mean, Objective
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX, checked_length
from offboard.robot_client.sites.runner import checked_timeout

DECISIONS = "decisions"  # the heading in the help
_decision_setting = partial(setting, group=DECISIONS, rare=True)
_limit_setting = partial(setting, group="limits", rare=True, minimum=0.0)
_objective_setting = partial(setting, group=OBJECTIVE, rare=True)
# The objectives that each setting belongs to; the first one cannot do without it.
USED_BY = {
    "deadline_s": ("deadline",),
    "s_per_joule": ("energy", "metered"),
    "s_per_megabyte": ("metered", "energy"),
}


@dataclass(frozen=True, kw_only=True)
class DecisionOptions:
    """What a robot learns with, and what it may spend."""

    window: int = setting(
        WINDOW, "executions remembered for each site", group=DECISIONS, minimum=2, maximum=WINDOW_MAX
    )
    predictor: str | None = _decision_setting(
        None,
        f"predictor to use instead of the one that the policy is meant for: {predictors.HELP}",
        metavar="NAME",
    )
    heartbeats: bool | None = _decision_setting(
        None,
        "ask each server that is used if it is there (default: unless the policy is meant to do without)",
    )
    memory: Path | str | None = _decision_setting(
        None, "file that keeps what the robot learns, and is read at start"
    )
    s_per_quality: float = _objective_setting(
        S_PER_QUALITY,
        "for tasks with variants: seconds that the whole quality of an answer is worth",
        minimum=0.0,
        maximum=1e6,
    )
    duplicates: float = _limit_setting(
        DUPLICATES,
        "share of tasks that may run on two sites, as probes or hedges",
        maximum=1.0,
        metavar="SHARE",
    )
    bytes_a_minute: float | None = _limit_setting(
        None, "bytes that may be sent and received in a minute; puts budget around the policy", maximum=1e15
    )
    joules_a_minute: float | None = _limit_setting(
        None,
        "joules that tasks may take from the battery in a minute; puts budget around the policy",
        maximum=1e9,
    )


@dataclass(frozen=True, kw_only=True)
class ObjectiveOptions(Energy):
    """What the policy makes small, with the weights and the watts of that."""

    objective: str = _objective_setting(
        MEAN,
        "what the policy minimises: mean time, the time that 95 % of the tasks stay below (p95), missed "
        "deadlines, or time plus what energy (energy) and data (metered) are worth",
        choices=objectives.OBJECTIVES,
    )
    deadline_s: float | None = _objective_setting(
        None,
        "with --objective deadline: time that a task may take, in seconds",
        name="deadline",
        minimum=0.001,
        maximum=3600,
    )
    s_per_joule: float | None = _objective_setting(
        None, "with --objective energy or metered: seconds that one joule is worth", minimum=0.0, maximum=1e6
    )
    s_per_megabyte: float | None = _objective_setting(
        None,
        "with --objective metered or energy: seconds that a million bytes, sent or received, are worth",
        minimum=0.0,
        maximum=1e6,
    )

    def make(self, name: str | None = None) -> Objective:
        """The objective of this name, or the chosen one; ConfigError if what it needs is not given."""
        return objectives.make(
            name or self.objective,
            deadline_s=self.deadline_s,
            s_per_joule=self.s_per_joule,
            s_per_megabyte=self.s_per_megabyte,
        )

    def check_objective(self, shown: Callable[[str], str]) -> None:
        """ConfigError unless the objective has what it needs, and no more.

        `shown`: how users write the name of a field.
        """
        for name, names in USED_BY.items():
            value = getattr(self, name)
            if self.objective == names[0] and value is None:
                raise ConfigError(f"{shown('objective')}: {names[0]} needs {shown(name)}")
            if self.objective not in names and value is not None:
                raise ConfigError(f"{shown(name)}: {value:g} needs {shown('objective')} {' or '.join(names)}")


@dataclass(frozen=True, kw_only=True)
class Settings(DecisionOptions):
    """Rare options of an offloader; the defaults suit most robots. Those of `DecisionOptions` come first.

    `objective`: what the policy makes small; see `policies.objectives`.
    `energy`: what computing, waiting and sending take from the battery, in watts and joules per byte.
    `compress`: whether large arguments are compressed where that should save time.
    `states`: what setups make; offloaders of one process that share it load each model once (None: its own).
    `insecure`: whether a policy server beyond this computer may be used by ws://, which is not encrypted, and
        servers of lists without keys.
    `known`: how many servers of a group of equal ones the robot uses at a time, 2 or more.
    `reread_s`: seconds between two reads of a list of servers.
    `seed`: for policies and predictors that draw; the same seed draws the same numbers.
    `tokens`: what policy servers want to see, by site, in place of NAME.token in the folder of the keys.
    `convert`: for policy servers that want other observations, by site: an object with two functions,
        `observation`, from that of the task to that of the server, and `action`, back from its answer.
    """

    objective: Objective = Mean()
    energy: Energy = Energy()
    compress: bool = True
    states: TaskStates | None = None
    insecure: bool = False
    known: int = KNOWN_MAX
    reread_s: float = 2.0
    seed: int = 0
    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)
    convert: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        check_types(Settings, {field.name: getattr(self, field.name) for field in fields(self)})
        check(self, "")
        checked_timeout(self.reread_s, "reread_s")

    def allowance(self) -> Allowance:
        """A fresh allowance: what tasks may spend from now on."""
        return Allowance(self.duplicates, self.bytes_a_minute, self.joules_a_minute)

    def make_policy(self, name: str) -> Policy:
        """The policy with this name; caps add the wrapper `budget` to it, but not to its name."""
        capped = self.allowance().capped and "budget" not in name.split(":")
        return Named(policies.make(f"budget:{name}" if capped else name, self.seed), name)

    def predictor_for(self, policy: str) -> str:
        """The name of the predictor: the one in these settings, else the one that the policy is meant for."""
        return policies.predictor_of(policy) if self.predictor is None else self.predictor

    def beats(self, policy: str) -> bool:
        """Whether the servers are sent heartbeats."""
        return policies.heartbeats(policy) if self.heartbeats is None else self.heartbeats

    def make_memories(self, policy: str) -> Memories:
        """What is known of each kind: nothing yet, or what the file `memory` holds.

        A wrong predictor or window is an error now, and not at the first task.
        """
        name = self.predictor_for(policy)
        make = partial(predictors.make, name, checked_length(self.window), self.seed)
        made = make()
        return Memories(
            make,
            measured=name == predictors.PARTS or self.beats(policy),
            shared_work=getattr(made, "per_work", False),
            objective=self.objective,
            energy=self.energy,
            s_per_quality=self.s_per_quality,
            store=None if self.memory is None else Store(Path(self.memory)),
        )


def check_types(of: Callable[..., Any], given: Mapping[str, Any]) -> None:
    """ConfigError unless each value has the type that is annotated for it in `of`."""
    for name, hint in typing.get_type_hints(of).items():
        if name in given and not _fits(given[name], hint):
            kinds = typing.get_args(hint) if _class_of(hint) in _UNIONS else (hint,)
            allowed = " or ".join(_shown(one) for one in kinds)
            raise ConfigError(f"{name} {given[name]!r:.200}: must be {allowed}")


_UNIONS = (UnionType, typing.Union)  # the second if a default is None, in Python 3.10
_SHOWN = {
    bool: "True or False",
    float: "a number",
    int: "a whole number",
    str: "a string",
    Path: "a path",
    Mapping: "a dictionary of strings",
    Iterable: "a list of functions",
    NoneType: "None",
}


def _shown(hint: Any) -> str:
    if _class_of(hint) is Mapping and Any in typing.get_args(hint):
        return "a dictionary"
    return _SHOWN.get(kind := _class_of(hint), str(kind.__name__))


def _fits(value: object, hint: Any) -> bool:
    kind, parts = _class_of(hint), typing.get_args(hint)
    if kind in _UNIONS:
        return any(_fits(value, one) for one in parts)
    if kind is Any:
        return True
    if kind in (int, float):  # numbers of numpy too
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if not isinstance(value, kind) or (kind is Iterable and isinstance(value, str)):
        return False
    if isinstance(value, Mapping):
        return all(_fits(key, parts[0]) and _fits(one, parts[1]) for key, one in value.items())
    return not isinstance(value, list | tuple) or all(_fits(one, parts[0]) for one in value)


def _class_of(hint: Any) -> Any:
    return typing.get_origin(hint) or hint
