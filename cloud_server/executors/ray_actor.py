"""What runs in a Ray actor: one task after the other. `ray_worker` is the other end. Ray is not imported."""

import faulthandler
import math
import os
import socket
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from offboard.cloud_server.executors.executor import Call, Outcome, bounded, run_task, warm_kinds
from offboard.cloud_server.executors.joint_run import run_joint
from offboard.cloud_server.executors.worker_process import ANSWER_BYTES_MAX, full, limit_memory
from offboard.common import VERSION, tasks
from offboard.common.cpu_time import SELF, process_s
from offboard.common.errors import TaskFailed, describe
from offboard.common.load import SERVER_EVERY_S, Load, LoadWatch
from offboard.common.source.comparison import read_files_of_server
from offboard.common.source.task_modules import load_modules
from offboard.common.task_states import TaskStates
from offboard.common.wire.blobs import StoredBlob

NOTHING = -1  # no run has this number


@dataclass(frozen=True, slots=True)
class ActorSetup:
    """What an actor needs to start. `path`: where the server finds modules; a node may lack some of it."""

    modules: tuple[str, ...]
    path: tuple[str, ...]
    memory_bytes_max: int


@dataclass(frozen=True, slots=True)
class Started:
    """What an actor says of its start: why it cannot run tasks, or else where it runs and which tasks."""

    error: str = ""
    traceback: str = ""
    of_task: bool = False
    host: str = ""
    pid: int = 0
    version: str = VERSION
    hashes: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Ran:
    """The outcome of a run. `full`: the process keeps so much memory that it must be replaced."""

    outcome: Outcome
    full: bool
    used_s: float


@dataclass(frozen=True, slots=True)
class Measured:
    """Load and capacity of the computer of an actor, and the CPU seconds that the actor has used."""

    load: float
    capacity: float
    used_s: float


class RayActor:
    """One worker. `run` is called for one task at a time; `stop` and `look` are called at any time."""

    def __init__(self) -> None:
        self._stopped = NOTHING
        self._blobs: dict[bytes, StoredBlob] = {}
        self._states = TaskStates(workers=1)
        self._siblings: tuple[int, ...] = ()  # other workers of the same server on this computer
        self._load = LoadWatch(Load(SELF, own_s=self._own_s), SERVER_EVERY_S)

    def start(self, setup: ActorSetup) -> Started:
        """Load the modules and prepare the tasks. Called once, before anything else."""
        faulthandler.enable()
        limit_memory(setup.memory_bytes_max)
        sys.path += [one for one in setup.path if one not in sys.path and Path(one).exists()]
        try:
            load_modules(setup.modules)
            read_files_of_server()
            warm_kinds(self._states)
        except TaskFailed as failure:
            return Started(str(failure), failure.traceback, of_task=True)
        except BaseException as error:  # noqa: BLE001 - a user's module may raise anything
            traceback.print_exc()
            return Started(describe(error))
        self._load.latest()
        return Started(host=socket.gethostname(), pid=os.getpid(), hashes=tuple(tasks.hashes().items()))

    def run(
        self,
        *blobs: Any,
        number: int,
        kind: str,
        frames: list[bytes],
        digests: Sequence[bytes],
        new: Sequence[bytes],
        dropped: Sequence[bytes],
        more: Sequence[tuple[list[bytes], Sequence[bytes], float]] = (),
    ) -> Ran:
        """Run one task. `digests` name its blobs; `new` names `blobs`, which this actor does not have.

        The blobs that were `dropped` are forgotten first. `more`: frames, digests and time limit of each task
        that runs together with this one.
        """
        for digest in dropped:
            self._blobs.pop(digest, None)
        for digest, data in zip(new, blobs, strict=True):
            self._blobs[digest] = StoredBlob(memoryview(data))
        first, *others = [
            Call(kind, one, self._known(named), lambda: self._stopped != number, budget_s=budget_s)
            for one, named, budget_s in ((frames, digests, math.inf), *more)
        ]
        if others:
            outcome = run_joint(replace(first, more=tuple(others)), self._states)
        else:
            outcome = run_task(first, self._states)
        outcome = _sendable(outcome)
        self._load.hurry()  # the load during the task, not before it
        outcome.load = self._load.latest()
        return Ran(outcome, full(outcome.error), process_s(os.getpid()))

    def _known(self, digests: Sequence[bytes]) -> dict[bytes, StoredBlob]:
        return {digest: self._blobs[digest] for digest in digests}

    def stop(self, number: int) -> None:
        """Nobody wants the answer of this run any more."""
        self._stopped = number

    def look(self, siblings: Sequence[int]) -> Measured:
        """Measure this computer, whose other workers are `siblings`."""
        self._siblings = tuple(siblings)
        return Measured(*self._load.latest(), process_s(os.getpid()))

    def _own_s(self) -> float:
        return sum(map(process_s, (os.getpid(), *self._siblings)))


def _sendable(outcome: Outcome) -> Outcome:
    """The same outcome, of bounded size and without views of memory."""
    outcome = bounded(outcome, ANSWER_BYTES_MAX)
    outcome.frames = [bytes(frame) for frame in outcome.frames]
    outcome.more = [_sendable(one) for one in outcome.more]
    return outcome
