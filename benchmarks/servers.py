"""Servers to measure: `cloud-server`, and other software that answers an empty call.

`python -m benchmarks.servers NAME` starts one of the others, and prints its port.
"""

import contextlib
import os
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


def http() -> None:
    """FastAPI on uvicorn, with an empty handler."""
    import uvicorn
    from fastapi import FastAPI

    @contextlib.asynccontextmanager
    async def listening(_app: FastAPI) -> AsyncIterator[None]:
        print(port, flush=True)
        yield

    port, app = free_port(), FastAPI(lifespan=listening)

    @app.post("/nothing")
    def nothing() -> None:
        pass

    uvicorn.run(app, host="127.0.0.1", port=port, log_level="error")


def grpc() -> None:
    """gRPC, with an empty unary call of bytes."""
    import grpc as library

    def nothing(request: bytes, _context: Any) -> bytes:
        return request

    handler = library.method_handlers_generic_handler(
        "bench", {"nothing": library.unary_unary_rpc_method_handler(nothing)}
    )
    server = library.server(ThreadPoolExecutor(2))
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    print(port, flush=True)
    server.wait_for_termination()


if __name__ == "__main__":
    {"echo": echo, "http": http, "grpc": grpc}[sys.argv[1]]()
