"""Which robots may talk to the server: those whose public keys are in a folder.

libzmq asks at each handshake only. If a robot is removed later, this file closes its connection.
"""

import errno
import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from zmq.utils import z85

from offboard.cloud_server.connections import end, other_end
from offboard.cloud_server.metrics import Metrics
from offboard.common.errors import ConfigError
from offboard.common.logs import RareLog
from offboard.common.security.keys import PUBLIC, read_public

ZAP = "inproc://zeromq.zap.01"  # the address where libzmq asks (RFC 27)
ZAP_VERSION = b"1.0"
ZAP_DOMAIN = b"offboard"
ZAP_FRAMES = 7  # version, id, domain, address, routing id, mechanism, key
RELOAD_S = 1.0  # between two checks of the folder
SETTLED_NS = 2_000_000_000  # from this age on, the time stamp of a file shows every later change
ROBOTS_MAX = 10_000  # key files; those beyond it, in the order of their names, are ignored
CUT_KEPT = 4096  # connections remembered as cut off, so that their waiting tasks do not run
NO_FILE = (errno.EMFILE, errno.ENFILE)  # connections have taken all files

log = logging.getLogger("offboard.cloud_server")


class Access:
    """Answers questions about connections: on a server without keys, each one counts as a robot of its own.

    All methods may be called from any thread.
    """

    def lets_in(self, peer: zmq.Frame) -> bool:  # noqa: ARG002
        """True if the server may read messages of the connection that this frame names."""
        return True

    def robot_of(self, peer: bytes) -> bytes:
        """The robot of this connection. A robot may have several connections."""
        return peer

    def name_of(self, robot: bytes) -> str:
        """The name of a robot, for people."""
        return f"connection {robot.hex()[-8:]}" if robot else "all others"

    def shut_out(self, peer: bytes, seconds: float) -> str:  # noqa: ARG002 - it cannot be recognised
        """Refuse new connections of this robot for a while; returns its name."""
        return "robot without a key"

    def knows(self, peer: bytes) -> bool:  # noqa: ARG002
        """True if tasks of this connection may still run and be answered."""
        return True


@dataclass(frozen=True, slots=True)
class _Connection:
    """A connection of a robot: `user` is its public key, `file` and `other_end` are known to the kernel."""

    user: str
    name: str
    file: int
    other_end: Any


class Authorisation(Access):
    """Access for the robots whose public keys are in a folder. A question costs about a microsecond.

    A thread answers libzmq, reads the folder again every RELOAD_S, and closes the connections of robots that
    were removed. It ends with the ZMQ context.
    """

    def __init__(self, context: "zmq.Context[Any]", folder: Path, metrics: Metrics) -> None:
        self._folder = folder
        self._metrics = metrics
        self._known: dict[str, str] = {}  # names of robots by their public keys
        self._seen: object = None  # the state of the folder when it was last read completely
        self._problems: list[str] = []
        self._connections: dict[bytes, _Connection] = {}
        self._cut: dict[bytes, None] = {}
        self._shut_out: dict[str, float] = {}  # for a public key, until when it is shut out
        self._log = RareLog(log)
        for problem in self._reload():
            raise ConfigError(f"--robots: {problem}")
        if not self._known:
            text = "--robots: %s holds no public key (*%s) yet: no robot can connect; remedy: copy keys there"
            log.warning(text, folder, PUBLIC)
        self._socket = context.socket(zmq.REP)
        self._socket.bind(ZAP)
        threading.Thread(target=self._run, name="robots", daemon=True).start()

    def lets_in(self, peer: zmq.Frame) -> bool:
        try:
            user = str(peer.get("User-Id"))
        except zmq.ZMQError:  # the connection has none
            user = ""
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

    def robot_of(self, peer: bytes) -> bytes:
        connection = self._connections.get(peer)
        return peer if connection is None else connection.user.encode()

    def name_of(self, robot: bytes) -> str:
        return self._known.get(robot.decode(errors="replace"), "all others")

    def shut_out(self, peer: bytes, seconds: float) -> str:
        connection = self._connections.get(peer)
        if connection is None:
            return "robot that has left"
        self._shut_out = {user: until for user, until in self._shut_out.items() if until > time.monotonic()}
        self._shut_out[connection.user] = time.monotonic() + seconds
        return f"robot {connection.name}"

    def knows(self, peer: bytes) -> bool:
        return peer not in self._cut

    def _run(self) -> None:
        """Answer libzmq and check the folder until the context ends."""
        try:
            while True:
                if self._socket.poll(int(RELOAD_S * 1000)):
                    self._socket.send_multipart(self._judge(self._socket.recv_multipart()))
                self._tend()
        except zmq.ContextTerminated:
            pass
        finally:
            self._known = {}  # if this thread ever ends before the server, no robot is let in
            self._socket.close(linger=0)

    def _tend(self) -> None:
        """If a check is due: read the folder, cut off removed robots, forget closed connections."""
        now = time.monotonic()
        if now < self._look_due:
            return
        problems = self._reload()
        for problem in problems:
            if problem not in self._problems:
                log.warning("--robots: %s; remedy: correct or remove it", problem)
        self._problems = problems
        for peer, connection in list(self._connections.items()):
            if connection.user not in self._known:
                self._cut_off(peer, connection)
            if connection.other_end is None or other_end(connection.file) != connection.other_end:
                self._connections.pop(peer, None)

    def _reload(self) -> list[str]:
        """Read the folder if it has changed; returns what is wrong in it. Unreadable: no robot is known."""
        self._look_due = time.monotonic() + RELOAD_S
        problems: list[str] = []
        try:
            files = sorted(
                path
                for path in self._folder.iterdir()
                if path.suffix == PUBLIC and not path.name.startswith(".")
            )
        except OSError as error:
            if error.errno in NO_FILE:
                return [f"{self._folder}: {error.strerror}; the robots stay as they are"]
            files = []
            problems.append(f"{self._folder}: {error.strerror}; it must hold the public key of each robot")
        seen = [(path, _state(path)) for path in files]
        if seen == self._seen:
            return []
        if len(files) > ROBOTS_MAX:
            problems.append(f"{self._folder}: {len(files)} keys, at most {ROBOTS_MAX} are allowed")
        known: dict[str, str] = {}
        for path in files[:ROBOTS_MAX]:
            try:
                known[read_public(path).decode()] = path.stem
            except ConfigError as error:
                if isinstance(error.__cause__, OSError) and error.__cause__.errno in NO_FILE:
                    return [str(error)]
                problems.append(str(error))
        # A recently changed file may change again without a later time stamp: then read it again.
        recent_ns = time.time_ns() - SETTLED_NS
        self._seen = None if problems or any(state[-1] > recent_ns for _, state in seen) else seen
        for what, some, others in (("known", known, self._known), ("removed", self._known, known)):
            if names := [name for key, name in some.items() if key not in others]:
                log.info("robots %s: %s", what, ", ".join(names))
        self._known = known
        return problems

    def _judge(self, asked: list[bytes]) -> list[bytes]:
        """The answer to a question of libzmq. The user id of a connection is its public key."""
        request_id = asked[1] if len(asked) > 1 else b""
        well_formed = len(asked) == ZAP_FRAMES and asked[0] == ZAP_VERSION and asked[5] == b"CURVE"
        user = z85.encode(asked[6]).decode() if well_formed and len(asked[6]) == 32 else ""
        if user in self._known and self._shut_out.get(user, 0.0) <= time.monotonic():
            return [ZAP_VERSION, request_id, b"200", b"OK", user.encode(), b""]
        self._metrics.refused.inc()
        where = asked[3].decode(errors="replace") if well_formed else "?"
        why = "was cut off a moment ago" if user in self._known else f"is not in {self._folder}"
        text = f"refused a robot at {where}: its key {user} {why}; "
        text += "remedy: if it is yours, copy its robot.key there"
        self._log(logging.WARNING, text, time.monotonic())
        return [ZAP_VERSION, request_id, b"400", b"unknown robot", b"", b""]

    def _cut_off(self, peer: bytes, connection: _Connection) -> None:
        """Close the connection. Its waiting tasks do not run, and its running tasks are not answered."""
        if peer in self._cut:
            return
        self._cut[peer] = None
        if len(self._cut) > CUT_KEPT:
            del self._cut[next(iter(self._cut))]
        log.warning(
            "cut off robot %s: its key is no longer in %s; remedy: if it is yours, copy its key there again",
            connection.name,
            self._folder,
        )
        end(connection.file, connection.other_end)


def _state(path: Path) -> tuple[int, ...]:
    """A value that differs after every change of the file; (0,) if the file was removed just now."""
    try:
        found = path.stat()
    except OSError:
        return (0,)
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
