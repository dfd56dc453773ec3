"""The calls of `calls`: the same call through Offboard, and through other software.

`python -m benchmarks.peers NAME` starts the server of one of them, and calls it as `caller` is asked to.
"""

import contextlib
import http.client
import pickle
import sys
import time
from collections.abc import Callable
from typing import Any

import zmq

from benchmarks.caller import Call, answer_orders
from benchmarks.servers import MESSAGE_BYTES_MAX, READY_S, cloud_server, length_of, serve
from benchmarks.tasks import length, nothing
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD

LISTENS_S = 0.5

Connect = Callable[[], Call]


def offboard(stack: contextlib.ExitStack) -> Connect:
    endpoint = stack.enter_context(cloud_server()).endpoint
    offload = stack.enter_context(Offloader.connect(endpoint, policy=CLOUD))
    absent = offload.wait_for_sites(length, READY_S)
    if absent:
        raise RuntimeError(f"the server is not ready: {absent}")

    def call(array: Any) -> int:
        if array is None:
            offload(nothing)
            got = 0
        else:
            got = offload(length, array)
        record = offload.last
        assert record is not None
        assert record.used == CLOUD, record.executions
        return got

    return lambda: call


def raw(stack: contextlib.ExitStack) -> Connect:
    """Sends the bytes, and gets them back."""
    port = serve(stack, "echo")

    def connect() -> Call:
        socket = _dealer(stack, port)

        def call(array: Any) -> int:
            socket.send_multipart([b"call", b"" if array is None else array], copy=False)
            return len(socket.recv_multipart(copy=False)[1])

        return call

    return connect


def zmq_pickle(stack: contextlib.ExitStack) -> Connect:
    port = serve(stack, "pickle")

    def connect() -> Call:
        socket = _dealer(stack, port)

        def call(array: Any) -> int:
            socket.send(pickle.dumps((array,), pickle.HIGHEST_PROTOCOL))
            got: int = pickle.loads(socket.recv())
            return got

        return call

    return connect


def grpc_pickle(stack: contextlib.ExitStack) -> Connect:
    import grpc

    limits = [(f"grpc.max_{way}_message_length", MESSAGE_BYTES_MAX) for way in ("send", "receive")]
    address = f"127.0.0.1:{serve(stack, 'grpc')}"

    def connect() -> Call:
        channel = stack.enter_context(grpc.insecure_channel(address, limits))
        method = channel.unary_unary("/bench/length", pickle.dumps, pickle.loads)

        def call(array: Any) -> int:
            got: int = method((array,))  # gRPC takes no None
            return got

        return call

    return connect


def fastapi(stack: contextlib.ExitStack) -> Connect:
    port = serve(stack, "http")
    time.sleep(LISTENS_S)  # the server prints its port just before it listens

    def connect() -> Call:
        connection = http.client.HTTPConnection("127.0.0.1", port)
        stack.callback(connection.close)

        def call(array: Any) -> int:
            connection.request("POST", "/length", b"" if array is None else memoryview(array))
            return int(connection.getresponse().read())

        return call

    return connect


def ray(stack: contextlib.ExitStack) -> Connect:
    import ray as library

    library.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    stack.callback(library.shutdown)
    actor = library.remote(_Actor).remote()  # type: ignore[attr-defined]

    def call(array: Any) -> int:
        got: int = library.get(actor.length.remote(array))
        return got

    return lambda: call


def dask(stack: contextlib.ExitStack) -> Connect:
    from distributed import Client

    client = stack.enter_context(Client(n_workers=1, threads_per_worker=2, dashboard_address=None))
    actor = client.submit(_Actor, actor=True).result()

    def call(array: Any) -> int:
        got: int = actor.length(array).result()
        return got

    return lambda: call


class _Actor:
    def length(self, array: Any) -> int:
        return length_of(array)


def _dealer(stack: contextlib.ExitStack, port: int) -> "zmq.Socket[bytes]":
    socket = stack.enter_context(zmq.Context.instance().socket(zmq.DEALER))
    socket.linger = 0
    socket.connect(f"tcp://127.0.0.1:{port}")
    return socket


PEERS: dict[str, Callable[[contextlib.ExitStack], Connect]] = {
    "offboard": offboard,
    "raw": raw,
    "pickle": zmq_pickle,
    "grpc": grpc_pickle,
    "fastapi": fastapi,
    "ray": ray,
    "dask": dask,
}

if __name__ == "__main__":
    with contextlib.ExitStack() as opened:
        answer_orders(PEERS[sys.argv[1]](opened))
