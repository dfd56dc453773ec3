"""Serves the clients of a policy server over WebSockets, each with sites of its own.

So an answer never goes to another client. Which server answers is decided by `policy_sites`.
"""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from offboard.common.errors import ConfigError, MissingExtra, OffloadError, describe
from offboard.robot_client.gateway.policy_sites import PolicySites
from offboard.robot_client.policy_servers.openpi import OpenPi, pack
from offboard.robot_client.policy_servers.protocol import OBSERVATION_BYTES_MAX, Raw, shortened

try:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import ServerConnection, serve
except ImportError as error:
    raise MissingExtra("robot-client gateway", "openpi") from error

SESSIONS_MAX = 64  # clients at a time
OBSERVATIONS_MAX = 4  # of one client that have come and wait
FAILED = 1011  # internal error (RFC 6455), as the servers of openpi close after an error
GOING = 1001  # the server ends
CLOSE_S = 1.0  # for a client to answer a close
REASON_LENGTH_MAX = 100  # of the error in a close; RFC 6455 allows 123 bytes


class WebSocketGateway:
    """Listens at `address`, and gives each client a thread and sites of its own, which `connect` makes."""

    def __init__(self, address: tuple[str, int], connect: Callable[[], PolicySites]) -> None:
        self._address, self._connect = address, connect
        self._clients: set[ServerConnection] = set()
        self._lock = threading.Lock()

    def serve(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, and end all sessions."""
        host, port = self._address
        options: dict[str, Any] = {
            "compression": None,
            "max_size": OBSERVATION_BYTES_MAX,
            "max_queue": OBSERVATIONS_MAX,
            "close_timeout": CLOSE_S,
            "ping_interval": None,
        }
        try:
            server = serve(self._handle, host, port, **options)
        except OSError as error:
            raise ConfigError(f"--listen: ws://{host}:{port}: {error.strerror}") from error
        thread = threading.Thread(target=server.serve_forever, name="listen", daemon=True)
        thread.start()
        print(f"clients connect to ws://{host}:{port}; Ctrl-C ends it", flush=True)
        stop.wait()
        server.shutdown()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            client.close(GOING)
        thread.join(CLOSE_S)

    def _handle(self, client: ServerConnection) -> None:
        with self._lock:
            full = len(self._clients) >= SESSIONS_MAX
            self._clients.add(client)
        try:
            if full:
                client.close(FAILED, f"at most {SESSIONS_MAX} clients are served")
                return
            with contextlib.suppress(ConnectionClosed), contextlib.closing(self._connect()) as sites:
                self._talk(client, sites)
        finally:
            with self._lock:
                self._clients.discard(client)

    def _talk(self, client: ServerConnection, sites: PolicySites) -> None:
        """Answer one observation after the other, until the client leaves."""
        protocol = OpenPi("")
        client.send(pack(sites.metadata()))
        for message in client:
            try:
                if not isinstance(message, bytes):
                    raise OffloadError("an observation is a binary message")
                answer = sites.call(Raw(message, protocol))
            except Exception as error:  # noqa: BLE001 - the client gets it, as from a policy server
                text = shortened(str(error) if isinstance(error, OffloadError) else describe(error))
                client.send(text)
                client.close(FAILED, text[:REASON_LENGTH_MAX])
                return
            client.send(answer.data)
