"""The contract of executors, which run the tasks of a server, and one run of a task, which they share."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from offboard.common import cpu_time, tasks
from offboard.common.errors import ProtocolError, TaskFailed, Unwanted, describe
from offboard.common.task_call import always, call_while, traceback_of
from offboard.common.task_states import TaskStates
from offboard.common.wire.blobs import Buffer, StoredBlob
from offboard.common.wire.messages import ERROR_LENGTH_MAX, byte_count
from offboard.common.wire.values import decode, encode

THIS_COMPUTER = "localhost"  # the place of workers that are threads or processes of the server

Blobs = Mapping[bytes, StoredBlob]


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """A task to run.

    `frames` are the encoded arguments; `blobs` holds the large ones by digest. `wanted` tells whether
    anybody still waits for the answer. After `budget_s` nobody does. `more`: further calls of the same
    kind, which run together with this one.
    """

    kind: str
    frames: Sequence[Buffer]
    blobs: Blobs = field(default_factory=dict)
    wanted: Callable[[], bool] = always
    budget_s: float = math.inf
    more: "tuple[Call, ...]" = ()

    @property
    def all_blobs(self) -> Blobs:
        """Those of all calls that run together."""
        return {**self.blobs, **{digest: blob for one in self.more for digest, blob in one.blobs.items()}}


@dataclass(slots=True)
class Outcome:
    """How a task went: `status` is ok, failed, or busy if it could not start.

    `run_s` is the time in the worker. `cpu_s` is the CPU time used during the run, by all processes under the
    same quota, or else by the process that ran the task. `server_fault`: the task failed, but the task is not
    the cause. `crashed`: its worker process died. `traceback`: of a task that raised, else empty.
    `load`: load and capacity of the computer that ran the task; None: the computer of the server.
    `together`: how many requests ran in one call; `more`: the outcomes of the further calls, in their order.
    `queue_s`: the time that the task waited in its worker. `note`: what the log of the server should say.
    """

    status: str
    error: str = ""
    run_s: float = 0.0
    cpu_s: float | None = None
    frames: list[Buffer] = field(default_factory=list)
    server_fault: bool = False
    crashed: bool = False
    traceback: str = ""
    load: tuple[float, float] | None = None
    together: int = 1
    queue_s: float = 0.0
    note: str = ""
    more: "Sequence[Outcome]" = ()


class Executor(Protocol):
    """Runs tasks. Any thread may call `submit`, `run` and `used_s`; only the owner calls the rest.

    An executor that inherits this class leaves out what is as for threads of this process.
    """

    name: str
    workers: int

    @property
    def up(self) -> int:
        """The workers that run a task or can take one. The others are being started again."""
        return self.workers

    def places(self) -> dict[str, int]:
        """How many workers are up on which computer."""
        return {THIS_COMPUTER: self.up}

    def load(self) -> tuple[float, float] | None:
        """Load and capacity of the computers of the workers, on average; None if that is this computer."""
        return None

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        """Start all workers, and run `setup` and `warm` of each kind in them. Called once; does not wait.

        From then on `changed` is called, in any thread, with one word for the reason when a worker dies, and
        with an empty text when a worker is up again.
        """
        ...

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        """Run a task now. Only called while fewer than `up` tasks run; the future never holds an exception.

        A task may end early if it notices that it is not wanted. A worker process is killed if its task runs
        much longer than its budget. `done` is called with the future: in the thread of the worker, or in this
        thread if no worker can take the task.
        """
        ...

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:  # noqa: ARG002
        """Run a task in this thread while another thread runs `meanwhile`, if that is not None.

        Returns None, and runs nothing, if this executor does not run tasks in the calling thread.
        """
        return None

    def used_s(self) -> float:
        """CPU seconds used so far by this process and its workers, including those that died."""
        return time.process_time()

    def close(self) -> None:
        """Abandon what runs, end the workers. Safe to call twice."""


def run_task(call: Call, states: TaskStates) -> Outcome:
    """Decode the arguments, call the task, encode its result. Every exception becomes the outcome."""
    cpu_before_s, started = cpu_time.used_s(), time.perf_counter()
    status, failure, traceback = "ok", "", ""
    in_task = server_fault = False
    result: list[Buffer] = []
    try:
        kind = tasks.kind_named(call.kind)
        args = arguments(kind, call)
        with states.lend(kind) as state:
            in_task = True
            value = call_while(call.wanted, kind.function, (*state, *args))
            in_task = False
        result = encode(value, kind.types, name="result").frames
    except BaseException as error:  # noqa: BLE001 - a task may raise anything
        status, failure = "failed", describe(error)
        server_fault = not in_task or isinstance(error, Unwanted)
        traceback = traceback_in(error, server_fault=server_fault)
    run_s, cpu_s = time.perf_counter() - started, cpu_time.used_s() - cpu_before_s
    return Outcome(
        status, failure, run_s, cpu_s, frames=result, server_fault=server_fault, traceback=traceback
    )


def traceback_in(error: BaseException, *, server_fault: bool) -> str:
    """The traceback of a task that raised. Of the server's own faults, only a raising `unpack` has one."""
    if not server_fault:
        return traceback_of(error)
    return "" if error.__cause__ is None else traceback_of(error.__cause__, _unpacked)


def arguments(kind: tasks.Kind, call: Call) -> Sequence[Any]:
    """The arguments of a call. An error that it raises is no fault of the task."""
    args = decode(call.frames, kind.types, call.blobs)
    if not isinstance(args, list):
        raise ProtocolError("the body is not a list of arguments")
    return args if kind.unpack is None else _unpacked(kind, args)


def _unpacked(kind: tasks.Kind, received: Sequence[Any]) -> Sequence[Any]:
    """The arguments that `unpack` makes of the one value received; ProtocolError if it does not make them."""
    assert kind.unpack is not None
    if len(received) != 1:
        raise ProtocolError(f"{len(received)} values for unpack of task {kind.name}, which takes one")
    try:
        made = kind.unpack(received[0])
    except MemoryError:  # the worker may have to be replaced
        raise
    except BaseException as error:  # the function is the user's own
        raise ProtocolError(f"unpack of task {kind.name}: {describe(error)}") from error
    try:
        return kind.bind(kind.arguments_in(made), {})
    except TypeError as error:
        raise ProtocolError(f"unpack of task {kind.name} returns other arguments: {error}") from error


def bounded(outcome: Outcome, bytes_max: int) -> Outcome:
    """The same outcome, or one that says that its result is too large."""
    size = byte_count(outcome.frames)
    if size > bytes_max:
        error = f"BadValue: the result takes {size} bytes, at most {bytes_max} are allowed"
        outcome = replace(outcome, status="failed", error=error, frames=[], server_fault=True, traceback="")
    outcome.error = outcome.error[:ERROR_LENGTH_MAX]
    return outcome


def warm_kinds(states: TaskStates) -> None:
    """Make the states of each kind, and run its `warm`. Once per process, before its first task.

    TaskFailed names the task and the error of its `setup` or `warm`, and has the frames of the user.
    """
    cpu_time.used_s()  # the first call looks for the cgroup
    for kind in tasks.kinds():
        for one in kind.on_servers():
            states.prepare(one)
        _warm(kind)


def _warm(kind: tasks.Kind) -> None:
    if kind.warm is None:
        return
    try:
        kind.warm()
    except BaseException as error:
        text = f"warm of task {kind.name}: {describe(error)}"
        raise TaskFailed(text, traceback_of(error, _warm)) from error
