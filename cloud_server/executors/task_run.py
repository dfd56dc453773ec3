"""One run of a task: the call, the running itself, and its outcome.

Threads, worker processes and Ray actors run tasks with this module; the executors decide where.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from offboard.common import tasks
from offboard.common.errors import ProtocolError, TaskFailed, Unwanted, describe
from offboard.common.host import cpu_time
from offboard.common.task_states import TaskStates
from offboard.common.tracebacks import traceback_of
from offboard.common.wanted import always, call_while
from offboard.common.wire.blobs import Buffer, StoredBlob
from offboard.common.wire.values import decode, encode

Blobs = Mapping[bytes, StoredBlob]


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """A task to run.

    `frames` are the encoded arguments; `blobs` holds the large ones by digest. `wanted` tells whether
    anybody still waits for the answer. After `budget_s` nobody does.
    """

    kind: str
    frames: Sequence[Buffer]
    blobs: Blobs = field(default_factory=dict)
    wanted: Callable[[], bool] = always
    budget_s: float = math.inf


@dataclass(slots=True)
class Outcome:
    """How a task went: `status` is ok, failed, or busy if it could not start.

    `run_s` is the time in the worker. `cpu_s` is the CPU time used during the run, by all processes under the
    same quota, or else by the process that ran the task. `server_fault`: the task failed, but the task is not
    the cause. `crashed`: its worker process died. `traceback`: of a task that raised, else empty.
    `load`: load and capacity of the computer that ran the task; None: the computer of the server.
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


def run_task(call: Call, states: TaskStates) -> Outcome:
    """Decode the arguments, call the task, encode its result. Every exception becomes the outcome."""
    cpu_before_s, started = cpu_time.used_s(), time.perf_counter()
    status, failure, traceback = "ok", "", ""
    in_task = server_fault = False
    result: list[Buffer] = []
    try:
        kind = tasks.kind_named(call.kind)
        args = decode(call.frames, kind.types, call.blobs)
        if not isinstance(args, list):
            raise ProtocolError("the body is not a list of arguments")
        if kind.unpack is not None:
            args = _unpacked(kind, args)
        with states.lend(kind) as state:
            in_task = True
            value = call_while(call.wanted, kind.function, (*state, *args))
            in_task = False
        result = encode(value, kind.types, name="result").frames
    except BaseException as error:  # noqa: BLE001 - a task may raise anything
        status, failure = "failed", describe(error)
        server_fault = not in_task or isinstance(error, Unwanted)
        traceback = _of_unpack(error) if server_fault else traceback_of(error)
    run_s, cpu_s = time.perf_counter() - started, cpu_time.used_s() - cpu_before_s
    return Outcome(
        status, failure, run_s, cpu_s, frames=result, server_fault=server_fault, traceback=traceback
    )


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


def _of_unpack(error: BaseException) -> str:
    """The traceback of an `unpack` that raised; empty for other faults of the server."""
    return "" if error.__cause__ is None else traceback_of(error.__cause__, _unpacked)


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
