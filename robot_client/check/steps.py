"""The steps of `robot-client check`: each one finds out one thing about a server, or fails with a remedy.

How the questions are sent is in `network`.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from offboard.common import VERSION as SOFTWARE
from offboard.common.empty_task import EMPTY
from offboard.common.security.address import on_loopback
from offboard.common.security.keys import ROBOT, SERVER, robot_keys
from offboard.common.tasks import hashes
from offboard.common.wire import messages as wire
from offboard.common.wording import duration
from offboard.robot_client.check import network
from offboard.robot_client.check.network import Listener, Session, StepFailed
from offboard.robot_client.check.task_comparison import compare, load_kinds
from offboard.robot_client.cloud.connection import UNKNOWN_ROBOT, HandshakeFailure
from offboard.robot_client.sites.endpoint import host_and_port
from offboard.robot_client.sites.runner import CLOUD

OK, FAIL, SKIP = "ok", "FAIL", "skip"
PINGS = 10


@dataclass(frozen=True, slots=True)
class Line:
    """The outcome of one step: its status is OK, FAIL or SKIP."""

    status: str
    step: str
    text: str = ""

    def __str__(self) -> str:
        return f"{self.status:<5} {self.step:<16}  {self.text}".rstrip()


class Check:
    """One check of the server at `endpoint`. Each step uses what the steps before it found out.

    `keys` is the folder of the robot's keys, `key` that of the server if a list has it. `modules` register
    the tasks that are compared, `timeout_s` bounds each step.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        keys: Path | None,
        modules: Sequence[str],
        timeout_s: float,
        key: bytes | None = None,
    ) -> None:
        self._endpoint = endpoint
        self._host, port = host_and_port(endpoint)
        self._port = int(port)
        self._folder = keys
        self._keys = None if keys is None else robot_keys(keys, CLOUD, key)
        self._kinds, self._chosen = load_kinds(modules), bool(modules)
        self._timeout_s = timeout_s
        self._ips: list[str] = []
        self._ip = ""  # the one that is used
        self._listener = Listener.OTHER
        self._opened = ExitStack()
        # Made by the steps "keys" and "hello":
        self._session: Session
        self._server: wire.Hello

    def run(self) -> Iterator[Line]:
        """The line of each step, as soon as the step is over. After a failed step, all others are skipped."""
        steps: dict[str, Callable[[], str]] = {
            "name resolves": self._resolve,
            "port is open": self._connect,
            "server answers": self._identify,
            "keys": self._shake_hands,
            "hello": self._say_hello,
            "tasks": self._compare_tasks,
            "round trip": self._ping,
            "empty task": self._run_empty_task,
        }
        failed = False
        with self._opened:
            for name, step in steps.items():
                line = Line(SKIP, name) if failed else self._take(name, step)
                failed = failed or line.status == FAIL
                yield line

    def _take(self, name: str, step: Callable[[], str]) -> Line:
        try:
            return Line(OK, name, step())
        except StepFailed as failed:
            return Line(FAIL, name, str(failed))

    def _resolve(self) -> str:
        try:
            self._ips = network.resolve(self._host, self._port)
        except OSError as error:
            raise StepFailed(
                f"{self._host}: {network.reason(error)}",
                "correct the name, or add it to DNS or /etc/hosts; containers must share a network",
            ) from error
        self._ip = self._ips[0]
        return f"{self._host} -> {' and '.join(self._ips)}"

    def _connect(self) -> str:
        port = self._port
        try:
            self._ip = network.connect(self._ips, port, self._timeout_s)
        except ConnectionRefusedError as error:
            raise StepFailed(
                f"nothing listens on port {port} of {self._ip}",
                f"start the server with {_listen_flags(self._ip, port)}, or correct the port",
            ) from error
        except OSError as error:
            raise StepFailed(
                f"port {port} of {self._ip}: {network.reason(error)}",
                "check that the computer is on and can be reached, and that no firewall blocks the port",
            ) from error
        return f"port {port} of {self._ip}"

    def _identify(self) -> str:
        try:
            self._listener = network.identify(self._ip, self._port, self._timeout_s)
        except OSError as error:
            raise StepFailed(f"no second connection: {network.reason(error)}", "check again") from error
        where = f"port {self._port}"
        if self._listener is Listener.HTTP:
            raise StepFailed(
                f"an HTTP server listens on {where}",
                "use the port of `cloud-server --listen`, 5555 by default, not that of --http",
            )
        if self._listener is Listener.CLOSING:
            raise StepFailed(
                f"{where} closes each connection at once",
                "if it is a relay (loadgen wan), check its --to and the server there; else correct the port",
            )
        if self._listener is Listener.OTHER:
            raise StepFailed(
                f"a program that is not a cloud-server listens on {where}",
                "use the port of `cloud-server --listen`, 5555 by default",
            )
        return "a ZMQ server"

    def _shake_hands(self) -> str:
        encrypted = self._listener is Listener.ENCRYPTED
        if encrypted and self._keys is None:
            raise StepFailed(
                "the server wants keys, and this robot has none",
                f"run `robot-client keys --out keys`, copy keys/{ROBOT}.key into the robots folder of the "
                f"server as NAME.key, copy {SERVER}.key of the server into keys, and pass --keys keys",
            )
        if not encrypted and self._keys is not None:
            raise StepFailed(
                "the server has no keys, and this robot has some",
                "start the server with --keys (`cloud-server keys` makes them), or leave out --keys here",
            )
        self._session = Session(self._endpoint, self._keys, self._timeout_s)
        self._opened.callback(self._session.close)
        outcome = self._session.handshake()
        if isinstance(outcome, HandshakeFailure) and outcome.text == UNKNOWN_ROBOT:
            raise StepFailed(
                "the server does not know the key of this robot",
                f"copy {self._folder}/{ROBOT}.key into the robots folder of the server, as NAME.key",
            )
        if isinstance(outcome, HandshakeFailure) and encrypted:
            raise StepFailed(
                f"{self._folder}/{SERVER}.key is not the key of this server",
                f"copy {SERVER}.key from the --keys folder of the server to {self._folder}",
            )
        if isinstance(outcome, HandshakeFailure) or outcome is None:
            raise StepFailed("the handshake does not end", "check the network, and the log of the server")
        return "encrypted (CURVE); each side knows the other" if encrypted else "none; nothing is encrypted"

    def _say_hello(self) -> str:
        try:
            server = self._session.hello(hashes())
        except wire.VersionMismatch as error:
            remedy = f"install the same version of Offboard on both sides; this robot has {SOFTWARE}"
            raise StepFailed(str(error), remedy) from error
        if server is None:
            raise StepFailed(
                f"the server has not answered within {self._timeout_s:g} s",
                "wait until it is ready (/ready of its --http address answers 200) and check again",
            )
        self._server = server
        size = server.message_bytes_max / 2**20
        versions = f"Offboard {server.software} there, {SOFTWARE} here"
        return f"wire version {wire.VERSION}; {versions}; messages up to {size:g} MiB"

    def _compare_tasks(self) -> str:
        server = self._server
        return compare(self._kinds, server.tasks, chosen=self._chosen, software=server.software)

    def _ping(self) -> str:
        round_trips_s = []
        for number in range(1, PINGS + 1):
            seconds = self._session.ping(number)
            if seconds is None:
                raise StepFailed(
                    f"ping {number} of {PINGS} got no answer within {self._timeout_s:g} s",
                    "check the network between robot and server, or pass a longer --timeout",
                )
            round_trips_s.append(seconds)
        median_s = statistics.median(round_trips_s)
        return f"median {duration(median_s)}, worst {duration(max(round_trips_s))} of {PINGS}"

    def _run_empty_task(self) -> str:
        if EMPTY not in self._server.tasks:
            raise StepFailed(
                f"the server has no task {EMPTY}, which every server of this version has",
                f"install Offboard {SOFTWARE} on the server",
            )
        reply = self._session.run(EMPTY)
        if reply is None:
            raise StepFailed(
                f"no answer within {self._timeout_s:g} s",
                "the workers may be busy: see waiting_requests in /metrics of the server, and check again",
            )
        if reply.status in ("busy", "expired"):
            raise StepFailed(
                f"the server is busy: {reply.error}", "check again later, or give it more --workers"
            )
        if reply.status != "ok":
            raise StepFailed(f"{reply.status}: {reply.error}", "look into the log of the server")
        return f"ran; it waited {duration(reply.queue_s)} and took {duration(reply.run_s)} on the server"


def _listen_flags(ip: str, port: int) -> str:
    """The flags of a server that this robot can reach; beyond loopback a server needs keys."""
    if on_loopback(ip):
        return f"--listen tcp://{ip}:{port}"
    return f"--listen 'tcp://*:{port}' --keys keys"
