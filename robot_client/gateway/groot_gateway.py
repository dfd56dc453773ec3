"""Serves the clients of a GR00T server over ZMQ, each with sites of its own.

Which server answers is decided by `policy_sites`. Clients over WebSockets are in `web_socket_gateway`.
"""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import zmq

from offboard.common.errors import ConfigError, OffloadError, describe
from offboard.robot_client.gateway.policy_sites import PolicySites
from offboard.robot_client.policy_servers.groot import GROOT, Groot
from offboard.robot_client.policy_servers.protocol import OBSERVATION_BYTES_MAX, Raw, shortened

SESSIONS_MAX = 64  # clients at a time
IDLE_S = 600.0  # after which a client that asks nothing has left: ZMQ does not tell
WAITING_MAX = 4  # requests of one client that wait
POLL_MS = 100  # between two looks whether the gateway ends
ANSWERS = "inproc://answers"
ENDPOINTS = ("ping", "get_action", "reset", "get_modality_config")
READY = {"status": "ok", "message": "Server is running"}

log = logging.getLogger(__name__)


class GrootGateway:
    """Listens at `endpoint` (groot://HOST:PORT). `connect` makes the sites of one client."""

    def __init__(self, endpoint: str, connect: Callable[[], PolicySites]) -> None:
        self._endpoint, self._connect = endpoint, connect
        self._sessions: dict[bytes, Session] = {}

    def serve(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, and end all sessions."""
        context = zmq.Context()
        with contextlib.ExitStack() as opened:
            opened.callback(context.term)
            clients, answers = context.socket(zmq.ROUTER), context.socket(zmq.PULL)
            for one in (clients, answers):
                one.setsockopt(zmq.LINGER, 0)
                opened.callback(one.close)
            clients.setsockopt(zmq.MAXMSGSIZE, OBSERVATION_BYTES_MAX)
            try:
                clients.bind(f"tcp://{self._endpoint.removeprefix(GROOT)}")
            except zmq.ZMQError as error:
                raise ConfigError(f"--listen: {self._endpoint}: {error}") from error
            answers.bind(ANSWERS)
            opened.callback(self._end_all)
            print(f"clients connect to {self._endpoint}; Ctrl-C ends it", flush=True)
            poller = zmq.Poller()
            poller.register(clients, zmq.POLLIN)
            poller.register(answers, zmq.POLLIN)
            while not stop.is_set():
                ready = dict(poller.poll(POLL_MS))
                if answers in ready:
                    clients.send_multipart(answers.recv_multipart())
                if clients in ready:
                    self._take(context, clients.recv_multipart())
                self._end_idle()

    def _take(self, context: "zmq.Context[Any]", frames: list[bytes]) -> None:
        if len(frames) != 3:
            log.warning("a request of %d frames was dropped; remedy: use a REQ socket", len(frames))
            return
        client, _, data = frames
        if client not in self._sessions:
            if len(self._sessions) >= SESSIONS_MAX:
                log.warning("at most %d clients are served; remedy: end some", SESSIONS_MAX)
                return
            self._sessions[client] = Session(client, context, self._connect)
        self._sessions[client].ask(data)

    def _end_idle(self) -> None:
        now_s = time.monotonic()
        for client in [one for one, session in self._sessions.items() if now_s - session.asked_s > IDLE_S]:
            self._sessions.pop(client).end()

    def _end_all(self) -> None:
        for session in self._sessions.values():
            session.end()
        for session in self._sessions.values():
            session.thread.join()


class Session:
    """One client: its requests are answered in a thread, one after the other."""

    def __init__(
        self, client: bytes, context: "zmq.Context[Any]", connect: Callable[[], PolicySites]
    ) -> None:
        self._client, self._connect = client, connect
        self._requests: queue.Queue[bytes | None] = queue.Queue(WAITING_MAX)
        self._answers = context.socket(zmq.PUSH)
        self._answers.setsockopt(zmq.LINGER, 0)
        self._answers.connect(ANSWERS)
        self.asked_s = time.monotonic()
        self.thread = threading.Thread(target=self._run, name="client", daemon=True)
        self.thread.start()

    def ask(self, data: bytes) -> None:
        self.asked_s = time.monotonic()
        try:
            self._requests.put_nowait(data)
        except queue.Full:
            log.warning("a client asks before it was answered: its request was dropped; remedy: use REQ")

    def end(self) -> None:
        """The thread ends when the present request has its answer."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._requests.get_nowait()
        self._requests.put_nowait(None)

    def _run(self) -> None:
        with contextlib.closing(self._answers), contextlib.closing(self._connect()) as sites:
            while (data := self._requests.get()) is not None:
                protocol = Groot("")
                try:
                    answer = self._answer(protocol, data, sites)
                except Exception as error:  # noqa: BLE001 - the client gets it, as from a policy server
                    said = str(error) if isinstance(error, OffloadError) else describe(error)
                    answer = protocol.pack_value({"error": shortened(said)})
                self._answers.send_multipart([self._client, b"", answer])

    def _answer(self, protocol: Groot, data: bytes, sites: PolicySites) -> bytes:
        endpoint = protocol.read_call(data).get("endpoint", "get_action")
        if endpoint == "ping":
            return protocol.pack_value(READY)
        if endpoint == "get_action":
            found = sites.call(Raw(data, protocol))
        elif endpoint in ("reset", "get_modality_config"):
            found = sites.ask_all(Raw(data, protocol), str(endpoint))
        else:
            raise OffloadError(f"endpoint {str(endpoint)[:40]!r}: the gateway answers {', '.join(ENDPOINTS)}")
        return bytes(found.data)
