"""The time of a call as a user makes it, with new data each time, through Offboard and other software.

Each of them has a server and a process that calls it, as `peers` starts them. They run in turns.
"""

import contextlib
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec

from benchmarks.measure import Requirement, Table
from benchmarks.servers import READY_S
from offboard.common.errors import describe
from tests.integration.openpi import environment

ROUNDS = 9
TOGETHER = 8  # calls under way at once, in as many threads
CASES = {  # bytes of the argument, and calls in a round
    "An empty call": (0, 304),
    "A scan of 5 KB": (5_000, 304),
    "An image of 0.9 MB": (900_000, 40),
    "A point cloud of 8 MB": (8_000_000, 8),
}
OURS, RAW = "offboard", "raw ZMQ echo of the bytes"
NAMES = {
    OURS: "offboard",
    RAW: "raw",
    "ZMQ with pickle": "pickle",
    "gRPC with pickle": "grpc",
    "FastAPI, keep-alive": "fastapi",
    "Ray actor": "ray",
    "Dask actor": "dask",
}
OPENPI = "openpi's client, policy-websocket"
MODULES = {"gRPC with pickle": "grpc", "Ray actor": "ray", "Dask actor": "distributed"}
SHARE_MEMORY = ("Ray actor",)
SMALL = {"gRPC with pickle": 1.25, "FastAPI, keep-alive": 1.25, "Ray actor": 2.0, "Dask actor": 2.5}
TOGETHER_LEAST = {"gRPC with pickle": 1.5, "Ray actor": 1.5}

Times = Mapping[str, float]  # seconds of a call, by name


def tables() -> Iterator[Table]:
    with contextlib.ExitStack() as stack:
        callers, missing = dict[str, subprocess.Popen[str]](), list[str]()
        for name in (*NAMES, OPENPI):
            try:
                callers[name] = _caller(stack, name)
            except Exception as error:  # noqa: BLE001 - the others must be measured if one does not start
                missing.append(f"{name}: {describe(error)}")
        for title, (size, count) in CASES.items():
            alone, together = _times(callers, size, count)
            yield _table(title, size, alone, together, missing)


def _caller(stack: contextlib.ExitStack, name: str) -> "subprocess.Popen[str]":
    if name in MODULES and find_spec(MODULES[name]) is None:
        raise RuntimeError(f"{MODULES[name]} is not installed")
    command = [sys.executable, "-m", "benchmarks.peers", NAMES.get(name, "")]
    if name == OPENPI:
        command = [str(environment.python()), "-m", "benchmarks.openpi_peer"]
    process = stack.enter_context(_calling(command))
    assert process.stdout is not None
    if "ready\n" not in process.stdout:
        raise RuntimeError("it did not start")
    _order(process, f"0 {TOGETHER} {TOGETHER}")
    return process


@contextlib.contextmanager
def _calling(command: Sequence[str]) -> Iterator["subprocess.Popen[str]"]:
    """A process that ends, and ends its server, when its input ends."""
    pipe, environ = subprocess.PIPE, os.environ | {"PYTHONPATH": str(environment.ROOT)}
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environ)
    try:
        yield process
    finally:
        process.communicate(timeout=READY_S)


def _times(callers: Mapping[str, "subprocess.Popen[str]"], size: int, count: int) -> tuple[Times, Times]:
    """The medians of all rounds, one call at a time and TOGETHER at once. The first round does not count."""
    alone, together = ({name: list[float]() for name in callers} for _ in range(2))
    for number in range(ROUNDS + 1):
        for name in list(callers) if number % 2 else reversed(callers):
            for threads, seconds in ((1, alone), (TOGETHER, together)):
                took_s = _order(callers[name], f"{size} {count} {threads}")
                if number:
                    seconds[name].append(took_s)
    return tuple({name: statistics.median(s) for name, s in each.items()} for each in (alone, together))  # type: ignore[return-value]


def _order(caller: "subprocess.Popen[str]", order: str) -> float:
    assert caller.stdin is not None
    assert caller.stdout is not None
    print(order, file=caller.stdin, flush=True)
    said = caller.stdout.readline()
    if not said:
        raise RuntimeError("it ended")
    return float(said)


def _table(title: str, size: int, alone: Times, together: Times, missing: list[str]) -> Table:
    ours, raw = alone[OURS], alone[RAW]
    rows = [
        [
            name,
            f"{alone[name] * 1e6:.0f}",
            f"{alone[name] / ours:.2f}",
            f"{alone[name] / raw:.2f}",
            f"{together[name] * 1e6:.0f}",
            f"{together[name] / together[OURS]:.2f}",
        ]
        for name in alone
    ]
    least = SMALL if size < 100_000 else dict.fromkeys((one for one in alone if one not in SHARE_MEMORY), 1.0)
    most = 3.0 if size < 100_000 else 1.3
    bars = [Requirement("offboard, relative to raw echo", ours / raw, most)]
    bars += [
        Requirement(f"{name}, relative to offboard", alone[name] / ours, limit, at_least=True)
        for name, limit in least.items()
        if name in alone and name not in (OURS, RAW)
    ]
    bars += [
        Requirement(f"{TOGETHER} at once: {name}, relative to offboard", rate, limit, at_least=True)
        for name, limit in TOGETHER_LEAST.items()
        if size == 0 and name in alone and (rate := together[name] / together[OURS])
    ]
    columns = ("call", "us", "over offboard", "over raw echo", f"us, {TOGETHER} at once", "over offboard")
    return Table(title, columns, rows, bars, missing=missing)
