"""Who may talk to the server: a folder of public keys, asked at each handshake and at each message.

libzmq asks at the handshake alone, so who is removed later is found here: its connection is closed.
"""

import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from zmq.utils import z85

from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.tcp_connections import end, other_end
from offboard.common.errors import ConfigError
from offboard.common.security.keys import PUBLIC, read_public

ZAP = "inproc://zeromq.zap.01"  # where libzmq asks (RFC 27)
ZAP_VERSION = b"1.0"
ZAP_DOMAIN = b"offboard"
ZAP_FRAMES = 7  # version, id, domain, address, routing id, mechanism, key
RELOAD_S = 1.0  # between two looks at the folder
SETTLED_NS = 2_000_000_000  # age at which the time of a file tells whether it was changed since
ROBOTS_MAX = 10_000  # files; those beyond it, by name, are not known
CUT_KEPT = 4096  # connections that were cut, and whose waiting tasks shall not run
LOG_PAUSE_S = 10.0  # least time between two warnings about refused robots

log = logging.getLogger("offboard.cloud_server")


@dataclass(frozen=True, slots=True)
class _Connection:
    """Whose it is: public key and name; its file, and what the kernel calls the other end of it."""

    user: str
    name: str
    file: int
    other_end: Any


class Robots:
    """The robots of a folder. `lets_in` and `knows` may be called from any thread, and cost a microsecond.

    A thread of its own answers libzmq's questions, looks at the folder every RELOAD_S, and cuts off whoever
    is no longer in it. It ends with the context.
    """

    def __init__(self, context: "zmq.Context[Any]", folder: Path, metrics: Metrics) -> None:
        self._folder = folder
        self._metrics = metrics
        self._known: dict[str, str] = {}  # name of the robot by its public key
        self._seen: object = None  # the folder, as it was last read whole
        self._problems: list[str] = []
        self._connections: dict[bytes, _Connection] = {}
        self._cut: dict[bytes, None] = {}
        self._shut_out: dict[str, float] = {}  # public keys, until when
        self._last_warning = -float("inf")
        for problem in self._reload():
            raise ConfigError(f"--robots: {problem}")
        if not self._known:
            log.warning("--robots: %s holds no public key (*%s) yet: no robot can connect", folder, PUBLIC)
        self._socket = context.socket(zmq.REP)
        self._socket.bind(ZAP)
        threading.Thread(target=self._run, name="robots", daemon=True).start()

    def lets_in(self, peer: zmq.Frame) -> bool:
        """Whether a message of this connection, named by its first frame, is to be read."""
        user = _user(peer)
        name = self._known.get(user)
        if name is None:
            self._metrics.dropped.labels("unknown robot").inc()
            return False
        connection = self._connections.get(peer.bytes)
        if connection is None or connection.user != user:
            file = int(peer.get(zmq.SRCFD))
            self._connections[peer.bytes] = _Connection(user, name, file, other_end(file))
            self._cut.pop(peer.bytes, None)
        return True

    def of(self, peer: bytes) -> bytes:
        """Whose connection this is, however many of his there are."""
        connection = self._connections.get(peer)
        return peer if connection is None else connection.user.encode()

    def shut_out(self, peer: bytes, seconds: float) -> str:
        """Refuse the handshakes of this robot for a while; its name."""
        connection = self._connections.get(peer)
        if connection is None:  # it is gone
            return "a robot"
        self._shut_out = {user: until for user, until in self._shut_out.items() if until > time.monotonic()}
        self._shut_out[connection.user] = time.monotonic() + seconds
        return connection.name

    def knows(self, peer: bytes) -> bool:
        """Whether a connection that was let in may still have tasks run, and hear of them."""
        return peer not in self._cut

    def _run(self) -> None:
        """Until the context ends."""
        try:
            while True:
                if self._socket.poll(int(RELOAD_S * 1000)):
                    self._socket.send_multipart(self._judge(self._socket.recv_multipart()))
                self._tend()
        except zmq.ContextTerminated:
            pass
        finally:
            self._known = {}  # should this thread ever end before the server does, nobody is let in
            self._socket.close(linger=0)

    def _tend(self) -> None:
        """Look at the folder when it is time, cut off who left it, forget connections that are closed."""
        now = time.monotonic()
        if now < self._look_due:
            return
        problems = self._reload()
        for problem in problems:
            if problem not in self._problems:
                log.warning("--robots: %s", problem)
        self._problems = problems
        for peer, connection in list(self._connections.items()):
            if connection.user not in self._known:
                self._cut_off(peer, connection)
            if connection.other_end is None or other_end(connection.file) != connection.other_end:
                self._connections.pop(peer, None)

    def _reload(self) -> list[str]:
        """Read the folder again if it changed; what is wrong in it. Unreadable: nobody is known."""
        self._look_due = time.monotonic() + RELOAD_S
        problems: list[str] = []
        known: dict[str, str] = {}
        try:
            files = sorted(
                path
                for path in self._folder.iterdir()
                if path.suffix == PUBLIC and not path.name.startswith(".")
            )
        except OSError as error:
            files = []
            problems.append(f"{self._folder}: {error.strerror}; the public key of each robot is wanted there")
        seen = [(path, _state(path)) for path in files]
        if seen == self._seen:
            return []
        if len(files) > ROBOTS_MAX:
            problems.append(f"{self._folder}: {len(files)} keys, at most {ROBOTS_MAX} are allowed")
        for path in files[:ROBOTS_MAX]:
            try:
                known[read_public(path).decode()] = path.stem
            except ConfigError as error:
                problems.append(str(error))
        # A file that was changed lately may change once more without a later time: then look again.
        lately_ns = time.time_ns() - SETTLED_NS
        self._seen = None if problems or any(state[-1] > lately_ns for _, state in seen) else seen
        self._say_changes(known)
        self._known = known
        return problems

    def _say_changes(self, known: dict[str, str]) -> None:
        for what, some, others in (("known", known, self._known), ("removed", self._known, known)):
            names = [name for key, name in some.items() if key not in others]
            if names:
                log.info("robots %s: %s", what, ", ".join(names))

    def _judge(self, asked: list[bytes]) -> list[bytes]:
        """Answer libzmq; the user of a connection is its public key."""
        request_id = asked[1] if len(asked) > 1 else b""
        well_formed = len(asked) == ZAP_FRAMES and asked[0] == ZAP_VERSION and asked[5] == b"CURVE"
        user = z85.encode(asked[6]).decode() if well_formed and len(asked[6]) == 32 else ""
        if user in self._known and self._shut_out.get(user, 0.0) <= time.monotonic():
            return [ZAP_VERSION, request_id, b"200", b"OK", user.encode(), b""]
        self._metrics.refused.inc()
        now = time.monotonic()
        if now - self._last_warning >= LOG_PAUSE_S:
            self._last_warning = now
            where = asked[3].decode(errors="replace") if well_formed else "?"
            why = "is shut out for a while" if user in self._known else f"is not in {self._folder}"
            log.warning("refused a robot at %s: its key %s %s", where, user, why)
        return [ZAP_VERSION, request_id, b"400", b"unknown robot", b"", b""]

    def _cut_off(self, peer: bytes, connection: _Connection) -> None:
        """End the connection; what it waits for shall not run, and what runs not be answered."""
        if peer in self._cut:
            return
        self._cut[peer] = None
        while len(self._cut) > CUT_KEPT:
            del self._cut[next(iter(self._cut))]
        log.warning("cut off robot %s: its key is no longer in %s", connection.name, self._folder)
        end(connection.file, connection.other_end)


def _user(peer: zmq.Frame) -> str:
    try:
        return str(peer.get("User-Id"))
    except zmq.ZMQError:  # it has none
        return ""


def _state(path: Path) -> tuple[int, ...]:
    """Of a file: another one after any change; none where it was removed at this moment."""
    try:
        found = path.stat()
    except OSError:
        return (0,)
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
