"""The HTTP port of a robot, or of `loadgen watch`: `/metrics` for Prometheus and `/live` for people.

It is Python's own HTTP server, which a robot has without an extra, and which does nothing while nobody asks.
What is shown comes from a registry and a source.
"""

import shutil
import socketserver
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from socket import AF_INET, AF_INET6
from threading import Event, Thread

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import MetricsHandler

from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.live.live_files import LIVE, LOOKS, PATHS, page_file
from offboard.common.live.look import EVERY_S, Source, Viewers, encode
from offboard.common.security.address import address as host_and_port
from offboard.common.security.address import on_loopback
from offboard.common.security.http_guard import HEADERS, PAGE_CSP, from_foreign_page

STALL_S = 10.0  # a client that neither sends nor reads for this long is left
WAITING_MAX = 64  # connections not yet accepted; a browser opens six, and one too many waits a second


class LivePort:
    """Answers GET /metrics and /live in background threads, from the start until `close`.

    address: HOST:PORT; port 0 picks a free one. where: the flag or field of the address, for messages.
    registry: what /metrics shows; None: there is no such path.
    """

    def __init__(
        self, address: str, where: str, *, source: Source, registry: CollectorRegistry | None = None
    ) -> None:
        place = host_and_port(where, address)
        try:
            self._server = _Server(place, source, registry)
        except (OSError, UnicodeError) as error:
            raise ConfigError(f"{where}: {address} cannot be served: {error}") from error
        self.url = f"http://{address.rpartition(':')[0]}:{self._server.server_port}"
        self._thread = Thread(target=self._server.serve_forever, name="live-port", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving. Open pages notice it within EVERY_S."""
        self._server.closing.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = WAITING_MAX

    def __init__(self, address: tuple[str, int], source: Source, registry: CollectorRegistry | None) -> None:
        self.address_family = AF_INET6 if ":" in address[0] else AF_INET
        self.source = source
        self.registry = registry
        self.loopback = on_loopback(address[0])
        self.closing = Event()
        self.viewers = Viewers()
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """Without the name of this computer, for which HTTPServer asks the network."""
        socketserver.TCPServer.server_bind(self)
        host, self.server_port = self.server_address[:2]
        self.server_name = str(host)


class _Handler(MetricsHandler):
    server: _Server
    timeout = STALL_S

    def do_GET(self) -> None:  # noqa: N802 - the base class calls it so
        path = self.path.partition("?")[0]
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        try:
            if from_foreign_page(host, origin, loopback_only=self.server.loopback):
                self._say(HTTPStatus.FORBIDDEN, "requests from other web pages are refused")
            elif path == LOOKS:
                self._send_looks()
            elif path in PATHS and path.startswith(LIVE):
                self._send_page(path)
            elif self.server.registry is not None:
                self.registry = self.server.registry
                super().do_GET()
            else:
                self._say(HTTPStatus.NOT_FOUND, f"the page is {LIVE}")
        except OSError:
            self.close_connection = True  # the client has left

    def _send_page(self, path: str) -> None:
        try:
            file = page_file(path)
        except MissingExtra as error:
            self._say(HTTPStatus.NOT_IMPLEMENTED, str(error))
            return
        with file.path.open("rb") as content:
            self._begin(HTTPStatus.OK, {**file.headers, "content-length": str(file.path.stat().st_size)})
            shutil.copyfileobj(content, self.wfile)

    def _send_looks(self) -> None:
        if self.server.viewers.full:
            self._say(HTTPStatus.SERVICE_UNAVAILABLE, Viewers.REFUSAL)
            return
        self._begin(HTTPStatus.OK, {"content-type": "text/event-stream", "cache-control": "no-store"})
        looks = self.server.source.looks()
        with self.server.viewers.one(looks):
            for look in looks:
                self.wfile.write(encode(look))
                if self.server.closing.wait(EVERY_S):
                    return

    def _say(self, status: HTTPStatus, text: str) -> None:
        body = f"{text.strip()}\n".encode()
        headers = {"content-type": "text/plain; charset=utf-8", "cache-control": "no-store"}
        self._begin(status, {**headers, "content-length": str(len(body))})
        self.wfile.write(body)

    def _begin(self, status: HTTPStatus, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "content-security-policy": PAGE_CSP, **headers}.items():
            self.send_header(name, value)
        self.end_headers()
