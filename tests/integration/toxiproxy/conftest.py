"""A relay with Toxiproxy's API, a Toxiproxy client from PyPI for it, and servers behind its proxies."""

import contextlib
import socketserver
import threading
from collections.abc import Callable, Iterator

import pytest
import toxiproxy

from tests.integration.toxiproxy.requests import Echo, client_of, running


@pytest.fixture
def upstream() -> Iterator[Callable[..., str]]:
    """Factory: starts a TCP server in threads, and returns its HOST:PORT."""
    with contextlib.ExitStack() as stack:

        def serve(talk: type[socketserver.BaseRequestHandler] = Echo) -> str:
            server = stack.enter_context(socketserver.ThreadingTCPServer(("127.0.0.1", 0), talk))
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            return f"127.0.0.1:{server.server_address[1]}"

        yield serve


@pytest.fixture(scope="module")
def relay_port() -> Iterator[int]:
    """The API port of one relay for all tests of a file."""
    with running() as port:
        yield port


@pytest.fixture
def client(relay_port: int) -> Iterator[toxiproxy.Toxiproxy]:
    """A third-party client of the relay, which has no proxies at first."""
    client = client_of(relay_port)
    yield client
    client.destroy_all()


@pytest.fixture
def api(relay_port: int, client: toxiproxy.Toxiproxy) -> int:
    """The API port of the relay, which has the proxy `p` to a port where nobody listens."""
    client.create(upstream="127.0.0.1:1", name="p")
    return relay_port
