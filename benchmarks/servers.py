"""`python -m benchmarks.servers NAME`: peers that answer an empty call; the first line says at which port."""

import contextlib
import socket
import sys
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


def echo() -> None:
    """ROUTER: what is sent comes back, frame by frame."""
    import zmq

    router = zmq.Context.instance().socket(zmq.ROUTER)
    print(router.bind_to_random_port("tcp://127.0.0.1"), flush=True)
    while True:
        router.send_multipart(router.recv_multipart(copy=False), copy=False)


def http() -> None:
    """FastAPI on uvicorn."""
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
    """A unary call of bytes."""
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
