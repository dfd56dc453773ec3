"""The options of `Offloader.connect` that few robots need.

The common options are keywords of `Offloader.connect` itself.
"""

import math
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.task_states import TaskStates
from offboard.robot_client import policies, predictors
from offboard.robot_client.discovery.roster import KNOWN_MAX
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.store import Store
from offboard.robot_client.policies import Policy
from offboard.robot_client.policies.allowance import DUPLICATES, Allowance
from offboard.robot_client.policies.decision import Named
from offboard.robot_client.policies.objectives import S_PER_QUALITY, Energy, Mean, Objective
from offboard.robot_client.predictors.window import WINDOW, checked_length
from offboard.robot_client.sites.runner import checked_timeout


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Rare options of an offloader; the defaults suit most robots.

    `predictor`: how times are predicted, by name (None: the predictor that the policy is meant for).
    `window`: the last times of each kind on each site that predictors with a window use.
    `heartbeats`: whether to ask each server that is used if it is there (None: as the policy needs it).
    `objective`: what the policy makes small; see `policies.objectives`.
    `s_per_quality`: what the whole quality of an answer is worth, in seconds, for tasks with variants.
    `energy`: what computing, waiting and sending take from the battery, in watts and joules per byte.
    `duplicates`: second runs per task in the long run, from 0 to 1: probes, hedges, warm-up.
    `bytes_a_minute`: the most bytes that tasks may send and receive in a minute (None: no cap).
    `joules_a_minute`: the most joules that tasks may take in a minute (None: no cap).
    `memory`: the file in which what was learnt outlives the process (None: a new process knows nothing).
    `compress`: whether large arguments are compressed where that should save time.
    `states`: what setups make; offloaders of one process that share it load each model once (None: its own).
    `insecure`: whether a policy server beyond this computer may be used by ws://, which is not encrypted, and
        servers of lists without keys.
    `known`: how many servers of a group of equal ones the robot uses at a time, 2 or more.
    `reread_s`: seconds between two reads of a list of servers.
    `seed`: for policies and predictors that draw; the same seed draws the same numbers.
    """

    predictor: str | None = None
    window: int = WINDOW
    heartbeats: bool | None = None
    objective: Objective = Mean()
    s_per_quality: float = S_PER_QUALITY
    energy: Energy = Energy()
    duplicates: float = DUPLICATES
    bytes_a_minute: float | None = None
    joules_a_minute: float | None = None
    memory: Path | str | None = None
    compress: bool = True
    states: TaskStates | None = None
    insecure: bool = False
    known: int = KNOWN_MAX
    reread_s: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_types(Settings, {name: getattr(self, name) for name in self.__slots__})
        if not 0 <= self.s_per_quality < math.inf:
            raise ConfigError(f"s_per_quality {self.s_per_quality}: must be a time of 0 s or more")
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
            kinds = typing.get_args(hint) if isinstance(hint, UnionType) else (hint,)
            allowed = " or ".join(_SHOWN.get(kind := _class_of(one), kind.__name__) for one in kinds)
            raise ConfigError(f"{name} {given[name]!r:.200}: must be {allowed}")


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


def _fits(value: object, hint: Any) -> bool:
    kind, parts = _class_of(hint), typing.get_args(hint)
    if kind is UnionType:
        return any(_fits(value, one) for one in parts)
    if kind in (int, float):  # numbers of numpy too
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if not isinstance(value, kind) or (kind is Iterable and isinstance(value, str)):
        return False
    items = [*value.keys(), *value.values()] if isinstance(value, Mapping) else value
    return not isinstance(items, list | tuple) or all(_fits(one, parts[0]) for one in items)


def _class_of(hint: Any) -> Any:
    return typing.get_origin(hint) or hint
