"""Servers to measure: `cloud-server`, and other software that answers the same calls.

`python -m benchmarks.servers NAME` starts one of the others, and prints its port.
"""

import contextlib
import os
import pickle
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import AsyncIterator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

READY_S = 30.0
POLL_S = 0.01
KEPT_S = 3600  # a connection that waits for its next round
MESSAGE_BYTES_MAX = 64 * 1024 * 1024  # of gRPC


@dataclass(frozen=True, slots=True)
class Server:
    """A `cloud-server` that is ready; its start took `took_s`."""

    endpoint: str
    http_port: int
    pid: int
    took_s: float


@contextlib.contextmanager
def running(command: Sequence[str], **environ: str) -> Iterator["subprocess.Popen[str]"]:
    """Run a process until the end of the block."""
    pipe = subprocess.PIPE  # also for the input, so that it does not end early
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=os.environ | environ)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=READY_S)  # also closes the pipes


@contextlib.contextmanager
def cloud_server(tasks: str = "benchmarks.tasks", **environ: str) -> Iterator[Server]:
    """Start `cloud-server` on loopback, without a rate limit for robots unless `environ` sets one."""
    endpoint, http = f"tcp://127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "offboard.cloud_server", "--listen", endpoint, "--tasks", tasks]
    began = time.perf_counter()
    unlimited = {"CLOUD_ROBOT_MIB_S": "65536"}
    with running([*command, "--http", http, "--log", "error"], **(unlimited | environ)) as process:
        while time.perf_counter() - began < READY_S:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"http://{http}/ready", timeout=1):
                break
            time.sleep(POLL_S)
        yield Server(endpoint, int(http.rpartition(":")[2]), process.pid, time.perf_counter() - began)


def serve(stack: contextlib.ExitStack, name: str) -> int:
    """Start one of the servers below in its own process, and return its port."""
    process = stack.enter_context(running([sys.executable, "-m", "benchmarks.servers", name]))
    assert process.stdout is not None
    return int(process.stdout.readline())


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


def echo() -> None:
    """A plain ROUTER socket that sends every frame back."""
    import zmq

    router = zmq.Context.instance().socket(zmq.ROUTER)
    print(router.bind_to_random_port("tcp://127.0.0.1"), flush=True)
    while True:
        router.send_multipart(router.recv_multipart(copy=False), copy=False)


def length_of(array: Any) -> int:
    """What the servers below compute: the bytes of an array; 0 for an empty call."""
    return 0 if array is None else int(array.nbytes)


def pickled() -> None:
    """A plain ROUTER socket, with arguments and result as pickles."""
    import zmq

    router = zmq.Context.instance().socket(zmq.ROUTER)
    print(router.bind_to_random_port("tcp://127.0.0.1"), flush=True)
    while True:
        robot, request = router.recv_multipart(copy=False)
        answer = length_of(*pickle.loads(request.buffer))
        router.send_multipart([robot, pickle.dumps(answer)])


def http() -> None:
    """FastAPI on uvicorn, which counts the bytes of a body."""
    import uvicorn
    from fastapi import FastAPI, Request

    @contextlib.asynccontextmanager
    async def listening(_app: FastAPI) -> AsyncIterator[None]:
        print(port, flush=True)
        yield

    port, app = free_port(), FastAPI(lifespan=listening)

    @app.post("/length")
    async def length(request: Request) -> int:
        return len(await request.body())

    uvicorn.run(app, host="127.0.0.1", port=port, log_level="error", timeout_keep_alive=KEPT_S)


def grpc() -> None:
    """gRPC, with an argument and a result as pickles."""
    import grpc as library

    handler = library.method_handlers_generic_handler(
        "bench",
        {
            "length": library.unary_unary_rpc_method_handler(
                lambda request, _context: length_of(*request), pickle.loads, pickle.dumps
            )
        },
    )
    limits = [(f"grpc.max_{way}_message_length", MESSAGE_BYTES_MAX) for way in ("send", "receive")]
    server = library.server(ThreadPoolExecutor(2), options=limits)
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    print(port, flush=True)
    server.wait_for_termination()


if __name__ == "__main__":
    {"echo": echo, "pickle": pickled, "http": http, "grpc": grpc}[sys.argv[1]]()
