"""Policy servers that do what a test says, in a thread of the test."""

import contextlib
import ssl
import threading
from collections.abc import Callable, Iterator

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from offboard.robot_client.policy_servers.openpi import pack

METADATA = pack({"name": "test"})
Talk = Callable[[ServerConnection], None]


@contextlib.contextmanager
def serving(
    talk: Talk, greeting: bytes | str | None = METADATA, tls: ssl.SSLContext | None = None
) -> Iterator[str]:
    """The endpoint of a server that greets each connection, and then talks to it."""

    def handle(connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            if greeting is not None:
                connection.send(greeting)
            talk(connection)

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=1.0, ssl=tls) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            scheme = "ws" if tls is None else "wss"
            yield f"{scheme}://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def says(*answers: bytes | str) -> Talk:
    """Answers observations with these messages, in turn, and then with the last one."""
    given = iter(answers)

    def talk(connection: ServerConnection) -> None:
        for _ in connection:
            connection.send(next(given, answers[-1]))

    return talk


def stays(connection: ServerConnection) -> None:
    """Reads, and answers nothing."""
    for _ in connection:
        pass
