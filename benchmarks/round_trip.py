"""The time of an empty task and of a task with 1 MB, compared to plain ZMQ and to other ways to call."""

import contextlib
import http.client
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import zmq

from benchmarks.measure import Requirement, Table, each_of
from benchmarks.robots import request_frames
from benchmarks.servers import READY_S, cloud_server, serve
from benchmarks.tasks import length, nothing
from offboard.common.errors import describe
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD

CALLS, MEGABYTE_CALLS = 200, 20
MEGABYTE = 1_000_000
LISTENS_S = 0.5
RAW = "raw ZMQ echo of the same bytes"
COLUMNS = ("call", "us", "relative to raw echo")


def tables() -> list[Table]:
    with contextlib.ExitStack() as stack:
        return [_empty(stack), _megabyte(stack)]


def _empty(stack: contextlib.ExitStack) -> Table:
    missing: list[str] = []
    cases: dict[str, Callable[[int], object]] = {
        RAW: _echo(stack, request_frames(nothing)),
        "offboard": _ours(stack, nothing),
        "FastAPI, keep-alive": _http(stack),
    }
    peers = {"grpc": ("gRPC, bytes", _grpc), "ray": ("Ray actor", _ray), "distributed": ("Dask actor", _dask)}
    for module, (name, start) in peers.items():
        if find_spec(module) is None:
            missing.append(f"{name}: {module} is not installed")
            continue
        try:
            cases[name] = start(stack)
        except Exception as error:  # noqa: BLE001 - the others must be measured if one does not start
            missing.append(f"{name}: did not start: {describe(error)}")
    seconds = each_of(cases, CALLS, rounds=9)
    ours, raw = seconds["offboard"], seconds[RAW]
    requirements = [Requirement("offboard, relative to raw echo", ours / raw, 4.0)]
    least = {"FastAPI, keep-alive": 1.0, "gRPC, bytes": 1.0, "Ray actor": 4.0, "Dask actor": 10.0}
    requirements += [
        Requirement(f"{name}, relative to offboard", seconds[name] / ours, limit, at_least=True)
        for name, limit in least.items()
        if name in seconds
    ]
    return Table("An empty task", COLUMNS, _rows(seconds, raw), requirements, missing=missing)


def _megabyte(stack: contextlib.ExitStack) -> Table:
    array = np.random.default_rng(1).integers(0, 255, MEGABYTE, np.uint8)
    arrays = [array + np.uint8(n) for n in range(MEGABYTE_CALLS)]  # different, so that no blob is known
    seconds = each_of(
        {RAW: _echo(stack, request_frames(length, array)), "offboard": _ours(stack, length, arrays)},
        MEGABYTE_CALLS,
        rounds=9,
    )
    raw = seconds[RAW]
    requirement = Requirement("offboard, relative to raw echo", seconds["offboard"] / raw, 1.6)
    return Table("A task with an array of 1 MB", COLUMNS, _rows(seconds, raw), [requirement])


def _rows(seconds: dict[str, float], raw: float) -> list[list[str]]:
    return [[name, f"{each * 1e6:.0f}", f"{each / raw:.2f}"] for name, each in seconds.items()]


def _echo(stack: contextlib.ExitStack, frames: list[Any]) -> Callable[[int], None]:
    socket = stack.enter_context(zmq.Context.instance().socket(zmq.DEALER))
    socket.linger = 0
    socket.connect(f"tcp://127.0.0.1:{serve(stack, 'echo')}")

    def call(count: int) -> None:
        for _ in range(count):
            socket.send_multipart(frames, copy=False)
            socket.recv_multipart(copy=False)

    return call


def _ours(
    stack: contextlib.ExitStack, function: Callable[..., Any], given: Any = None
) -> Callable[[int], None]:
    """Calls through the real client and server; `given` are the arguments."""
    endpoint = stack.enter_context(cloud_server()).endpoint
    offload = stack.enter_context(Offloader.connect(endpoint, policy=CLOUD))
    absent = offload.wait_for_sites(function, READY_S)
    if absent:
        raise RuntimeError(f"the server is not ready: {absent}")

    def call(count: int) -> None:
        for n in range(count):
            if given is None:
                offload(function)
            else:
                given[n][:8] += 1  # a different array in each call
                offload(function, given[n])
        record = offload.last
        assert record is not None
        assert record.used == CLOUD, record.executions

    return call


def _http(stack: contextlib.ExitStack) -> Callable[[int], None]:
    connection = http.client.HTTPConnection("127.0.0.1", serve(stack, "http"))
    time.sleep(LISTENS_S)  # the server prints its port just before it listens
    stack.callback(connection.close)

    def call(count: int) -> None:
        for _ in range(count):
            connection.request("POST", "/nothing")
            connection.getresponse().read()

    return call


def _grpc(stack: contextlib.ExitStack) -> Callable[[int], None]:
    import grpc

    channel = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{serve(stack, 'grpc')}"))
    method = channel.unary_unary("/bench/nothing")

    def call(count: int) -> None:
        for _ in range(count):
            method(b"")

    return call


def _ray(stack: contextlib.ExitStack) -> Callable[[int], None]:
    import ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    stack.callback(ray.shutdown)

    @ray.remote
    class Actor:
        def nothing(self) -> None:
            pass

    actor = Actor.remote()  # type: ignore[attr-defined]

    def call(count: int) -> None:
        for _ in range(count):
            ray.get(actor.nothing.remote())

    return call


class _Actor:
    def nothing(self) -> None:
        pass


def _dask(stack: contextlib.ExitStack) -> Callable[[int], None]:
    from distributed import Client

    client = stack.enter_context(Client(n_workers=1, threads_per_worker=1, dashboard_address=None))
    actor = client.submit(_Actor, actor=True).result()

    def call(count: int) -> None:
        for _ in range(count):
            actor.nothing().result()

    return call
