"""The local testbed: cloud server, relay and robot as child processes on loopback, all gone when it is.

What they do is their own business; which tasks are run and what fails when is the scenario's.
"""

import contextlib
import http.client
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Self

from common.errors import ConfigError, OffloadError
from loadgen.quota import Quota, hold

READY_S = 60.0  # compiling the planner for the first time takes most of it
LAUNCH_S = 10.0
ASK_S = 2.0
POLL_S = 0.05
TERMINATE_S = 5.0
KILL_S = 5.0
TAIL_LINES = 15
TAIL_BYTES = 1 << 16
USAGE_EXIT = 2
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

COMMANDS: Mapping[str, Sequence[str]] = {
    "cloud": (sys.executable, "-m", "cloud_server"),
    "wan": (sys.executable, "-m", "loadgen", "wan"),
    "robot": (sys.executable, "-m", "robot_client"),
}

# Becomes the command argv[3:], killed by the kernel when the testbed (argv[1]) dies, stopped or not. The
# pipe argv[2] closes at that moment. The parent is asked for after prctl: one that died before is not told.
LAUNCHER = """
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
    sys.exit("prctl: " + os.strerror(ctypes.get_errno()))
if os.getppid() != int(sys.argv[1]):
    sys.exit("the testbed is gone")
os.set_inheritable(int(sys.argv[2]), False)
try:
    os.execvp(sys.argv[3], sys.argv[3:])
except OSError as error:
    sys.exit(f"cannot run {sys.argv[3]}: {error.strerror}")
"""


@dataclass(frozen=True, slots=True)
class Part:
    """One process: its command, the address (host:port) and path that answer 200 once it is ready, and
    the CPUs it is held to. Its output goes to logs/NAME.log, or where ours goes if `inherit`."""

    name: str
    command: tuple[str, ...]
    http: str | None = None
    ready: str = "/ready"
    cpus: float | None = None
    inherit: bool = False


@dataclass(slots=True)
class Child:
    """A part that was started."""

    part: Part
    process: subprocess.Popen[bytes]
    log: Path
    log_start: int  # where its own lines begin
    quota: Quota | None = None

    def let_go(self) -> None:
        """Release it from its quota and continue it."""
        if self.quota is not None:
            self.quota.close()
            self.quota = None
        self.send(signal.SIGCONT)

    def send(self, number: signal.Signals) -> None:
        """Signal the child and its own worker processes, which are in its process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def tail(self) -> str:
        """The last lines that it logged."""
        with self.log.open("rb") as file:
            file.seek(max(self.log_start, self.log.stat().st_size - TAIL_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:]) or "(it logged nothing)"


class Testbed:
    """Starts parts and ends them in the reverse order, whatever happens. A context manager.

    Ctrl-C and SIGTERM leave the `with` block by an exception, and with that end the parts; should this
    process be killed, the kernel kills them. Use it from the main thread only: the kernel takes the end of
    the thread that started a child for the end of its parent.
    """

    __test__ = False  # not a test, whatever pytest thinks of the name

    def __init__(self, out: Path, *, ready_s: float = READY_S) -> None:
        self.out = out
        self.ready_s = ready_s
        self._children: dict[str, Child] = {}
        self._terminate_before: Any = None

    def __enter__(self) -> Self:
        self._terminate_before = signal.signal(signal.SIGTERM, _exit)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        finally:
            signal.signal(signal.SIGTERM, self._terminate_before)

    def start_part(self, part: Part) -> Child:
        """Start the part, again if it has ended, and wait until it is ready."""
        assert threading.current_thread() is threading.main_thread(), "children die with the thread"
        child = self._launch(part)
        if part.cpus is not None:
            child.quota = hold(child.process.pid, part.cpus)
        if part.http is not None:
            _wait_ready(child, self.ready_s)
        return child

    def child(self, name: str) -> Child:
        return self._children[name]

    def quota(self, name: str) -> Quota | None:
        """The quota in force on a part."""
        return self._children[name].quota

    def running(self, name: str) -> bool:
        child = self._children.get(name)
        return child is not None and child.process.poll() is None

    def kill(self, name: str) -> None:
        """End a part as a crash would: SIGKILL, no chance to say anything."""
        child = self._children[name]
        child.send(signal.SIGKILL)
        child.process.wait(KILL_S)
        child.let_go()

    def pause(self, name: str) -> None:
        """Stop a part where it is, as a hang would, until `resume`."""
        child = self._children[name]
        if child.quota is not None:
            child.quota.pause()
        else:
            child.send(signal.SIGSTOP)

    def resume(self, name: str) -> None:
        child = self._children[name]
        if child.quota is not None:
            child.quota.resume()
        else:
            child.send(signal.SIGCONT)

    def wait(self, name: str, timeout_s: float | None = None) -> int:
        """The exit code of a part, once it ends; OffloadError if it does not within `timeout_s`."""
        child = self._children[name]
        try:
            code = child.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise OffloadError(f"{name} has not ended after {timeout_s:g} s") from None
        child.let_go()
        return code

    def close(self) -> None:
        """End all parts, last started first. Ctrl-C does not interrupt it, and it takes a bounded time."""
        with _uninterrupted():
            for child in reversed(self._children.values()):
                _end(child)
            self._children.clear()

    def _launch(self, part: Part) -> Child:
        """Start the part; on return it can no longer outlive us, so it may be stopped."""
        assert not self.running(part.name), f"{part.name} is running already"
        log = self.out / "logs" / f"{part.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack, _uninterrupted():  # what is started is in `_children`
            file = stack.enter_context(log.open("ab" if part.name in self._children else "wb"))
            launched, launching = os.pipe()
            stack.callback(os.close, launched)
            output: Any = {} if part.inherit else {"stdout": file, "stderr": subprocess.STDOUT}
            command = [
                sys.executable,
                "-I",
                "-S",
                "-c",
                LAUNCHER,
                str(os.getpid()),
                str(launching),
                *part.command,
            ]
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, start_new_session=True, pass_fds=[launching], **output
            )
            os.close(launching)
            child = self._children[part.name] = Child(part, process, log, log_start=file.tell())
            if not select.select([launched], [], [], LAUNCH_S)[0]:
                raise OffloadError(f"{part.name} could not be launched within {LAUNCH_S:g} s")
        return child


class LocalTestbed(Testbed):
    """The three processes of a run: robot --> relay --> cloud, on free ports of loopback.

    `link` holds flags of `loadgen wan` by name (`delay_ms`, `up_delay_ms`, `seed`, ...), `commands` how each
    part is started: anything that takes the same flags.
    """

    def __init__(
        self,
        out: Path,
        *,
        link: Mapping[str, Any] | None = None,
        cloud_args: Sequence[str] = (),
        robot_cpus: float | None = None,
        ready_s: float = READY_S,
        commands: Mapping[str, Sequence[str]] = COMMANDS,
    ) -> None:
        super().__init__(out, ready_s=ready_s)
        cloud, self.cloud_http, relay, self.wan_http = (f"127.0.0.1:{port}" for port in _free_ports(4))
        self.robot_cpus = robot_cpus
        self.robot_command = (*commands["robot"], "--cloud", f"tcp://{relay}")
        conditions = [f"--{name.replace('_', '-')}={value}" for name, value in (link or {}).items()]
        cloud_flags = ("--listen", f"tcp://{cloud}", "--http", self.cloud_http, *cloud_args)
        wan_flags = ("--listen", relay, "--to", cloud, "--http", self.wan_http, *conditions)
        self.parts = {
            "cloud": Part("cloud", (*commands["cloud"], *cloud_flags), http=self.cloud_http),
            "wan": Part("wan", (*commands["wan"], *wan_flags), http=self.wan_http, ready="/health"),
        }

    def start(self, *names: str) -> None:
        """Start cloud and relay, or those named, again on the same ports; each is ready on return."""
        for name in names or self.parts:
            self.start_part(self.parts[name])

    def start_robot(self, args: Sequence[str], *, inherit: bool = True) -> Child:
        """Start the robot, held to `robot_cpus`."""
        command = (*self.robot_command, *args)
        return self.start_part(Part("robot", command, cpus=self.robot_cpus, inherit=inherit))

    def run_robot(self, args: Sequence[str], *, timeout_s: float | None = None, inherit: bool = True) -> int:
        """Run the robot to its end; its exit code."""
        self.start_robot(args, inherit=inherit)
        return self.wait("robot", timeout_s)

    def set_link(self, **changes: Any) -> dict[str, Any]:
        """Change the link's conditions, as PUT /link of the relay takes them; the whole link on return."""
        return self._ask_link("PUT", json.dumps(changes))

    def link(self) -> dict[str, Any]:
        """The link as it is, with counts of connections and bytes."""
        return self._ask_link("GET")

    def _ask_link(self, method: str, body: str | None = None) -> dict[str, Any]:
        status, text = _ask(self.wan_http, method, "/link", body)
        answer: dict[str, Any] = json.loads(text)
        if status != http.client.OK:
            raise ConfigError(f"link: {answer.get('detail', text)}")
        return answer


def _wait_ready(child: Child, timeout_s: float) -> None:
    """Poll until the part answers 200; an error with what it logged if it ends first, or takes too long."""
    part = child.part
    assert part.http is not None
    end_s = time.monotonic() + timeout_s
    while child.process.poll() is None:
        with contextlib.suppress(OffloadError):
            if _ask(part.http, "GET", part.ready)[0] == http.client.OK:
                return
        if time.monotonic() > end_s:
            raise OffloadError(
                f"{part.name} was not ready within {timeout_s:g} s; it logged:\n{child.tail()}"
            )
        time.sleep(POLL_S)
    code = child.process.returncode
    if code == USAGE_EXIT:
        raise ConfigError(child.tail())
    raise OffloadError(
        f"{part.name} ended at start, exit code {code}; {child.log} ends with:\n{child.tail()}"
    )


def _end(child: Child) -> None:
    """Let it go, ask it to end, make it end; then whatever workers it left."""
    child.let_go()
    if child.process.poll() is None:
        child.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(TERMINATE_S)
    child.send(signal.SIGKILL)
    child.process.wait(KILL_S)


def _ask(address: str, method: str, path: str, body: str | None = None) -> tuple[int, str]:
    connection = http.client.HTTPConnection(address, timeout=ASK_S)
    headers = {} if body is None else {"Content-Type": "application/json"}
    try:
        with contextlib.closing(connection):
            connection.request(method, path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read().decode()
    except (OSError, http.client.HTTPException) as error:
        raise OffloadError(f"http://{address}{path} does not answer: {error}") from error


def _free_ports(count: int) -> list[int]:
    """Ports of loopback that nobody listens on; all open at once, so that they differ."""
    with contextlib.ExitStack() as stack:
        taken = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [port.getsockname()[1] for port in taken]


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Keep Ctrl-C and SIGTERM until the block is left. Not by blocking them: children would inherit that."""
    kept: list[int] = []
    before = {number: signal.signal(number, lambda n, _: kept.append(n)) for number in INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for interrupt in set(kept):
            signal.raise_signal(interrupt)


def _exit(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)
