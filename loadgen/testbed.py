"""The local testbed: cloud server, relay and robot as child processes on loopback, all gone when it is.

What they do is their own business; which tasks are run and what fails when is the scenario's.
"""

import contextlib
import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Self

from common.errors import ConfigError, OffloadError
from loadgen.flags import as_flags
from loadgen.part import KILL_S, Child, Part, ask, end, launch, uninterrupted, wait_ready
from loadgen.quota import Quota, hold

READY_S = 60.0  # compiling the planner for the first time takes most of it

COMMANDS: Mapping[str, Sequence[str]] = {
    "cloud": (sys.executable, "-m", "cloud_server"),
    "wan": (sys.executable, "-m", "loadgen", "wan"),
    "robot": (sys.executable, "-m", "robot_client"),
}


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
        assert not self.running(part.name), f"{part.name} is running already"
        with uninterrupted():  # what is started is in `_children`
            log, again = self.out / "logs" / f"{part.name}.log", part.name in self._children
            child = self._children[part.name] = launch(part, log, again=again)
            child.wait_launched()
        if part.cpus is not None:
            child.quota = hold(child.process.pid, part.cpus)
        if part.http is not None:
            wait_ready(child, self.ready_s)
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
        with uninterrupted():
            for child in reversed(self._children.values()):
                end(child)
            self._children.clear()


class LocalTestbed(Testbed):
    """The three processes of a run: robot --> relay --> cloud, on free ports of loopback.

    `endpoint` is where a robot finds the cloud, through the relay.

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
        self.endpoint = f"tcp://{relay}"
        self.robot_command = (*commands["robot"], "--cloud", self.endpoint)
        cloud_flags = ("--listen", f"tcp://{cloud}", "--http", self.cloud_http, *cloud_args)
        wan_flags = ("--listen", relay, "--to", cloud, "--http", self.wan_http, *as_flags(link or {}))
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
        status, text = ask(self.wan_http, method, "/link", body)
        answer: dict[str, Any] = json.loads(text)
        if status != http.client.OK:
            raise ConfigError(f"link: {answer.get('detail', text)}")
        return answer


def _free_ports(count: int) -> list[int]:
    """Ports of loopback that nobody listens on; all open at once, so that they differ."""
    with contextlib.ExitStack() as stack:
        taken = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [port.getsockname()[1] for port in taken]


def _exit(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)
