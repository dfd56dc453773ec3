"""How a task went, and the running of one: what threads and worker processes have in common."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from offboard.common import tasks
from offboard.common.errors import ProtocolError, Unwanted, describe
from offboard.common.host import cpu_time
from offboard.common.wanted import always, call_while
from offboard.common.wire.blobs import Buffer, StoredBlob
from offboard.common.wire.values import decode, encode

Blobs = Mapping[bytes, StoredBlob]


@dataclass(slots=True)
class Outcome:
    """How a task went: ok, failed, or busy where it could not start; `run_s` is the time in the worker.

    `cpu_s` is the CPU time used meanwhile, by all that shares the quota, or else by the process that ran it.
    `server_fault`: it failed, but not by its own doing. `crashed`: its worker process did not outlive it.
    """

    status: str
    error: str = ""
    run_s: float = 0.0
    cpu_s: float | None = None
    frames: list[Buffer] = field(default_factory=list)
    server_fault: bool = False
    crashed: bool = False


def run_task(
    kind_name: str, frames: Sequence[Buffer], blobs: Blobs, wanted: Callable[[], bool] = always
) -> Outcome:
    """Decode the arguments, call the task, encode its result; whatever it raises becomes the outcome."""
    cpu_before_s, started = cpu_time.used_s(), time.perf_counter()
    status, failure, unwanted = "ok", "", False
    result: list[Buffer] = []
    try:
        kind = tasks.kind_named(kind_name)
        args = decode(frames, kind.types, blobs)
        if not isinstance(args, list):
            raise ProtocolError("the body is not a list of arguments")
        result = encode(call_while(wanted, kind.function, args), kind.types).frames
    except BaseException as error:  # noqa: BLE001 - a task may raise anything
        status, failure, unwanted = "failed", describe(error), isinstance(error, Unwanted)
    run_s = time.perf_counter() - started
    return Outcome(status, failure, run_s, cpu_time.used_s() - cpu_before_s, result, server_fault=unwanted)


def warm_kinds() -> None:
    """Run the warm of each kind, once a process."""
    cpu_time.used_s()  # the first call looks for what to read
    for kind in tasks.kinds():
        if kind.warm is not None:
            kind.warm()
