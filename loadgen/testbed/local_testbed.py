"""The local testbed: runs the parts as child processes on loopback, and ends them with itself.

`part_process` starts and ends one process, `cpu_quota` limits its CPU time.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from offboard.common.errors import OffloadError
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.relay_client import RelayClient
from offboard.loadgen.testbed.cpu_quota import Quota, hold
from offboard.loadgen.testbed.part_process import (
    KILL_S,
    Child,
    Part,
    end,
    launch,
    leave,
    uninterrupted,
    wait_ready,
)
from offboard.loadgen.testbed.testbed import (
    CLOUD,
    ROBOT,
    WAN,
    Setup,
    Usage,
    kind_of,
    relay_of,
    servers_among,
    servers_behind,
)

READY_S = 60.0  # the first compilation of the planner takes most of it
HOG = "while True: pass"

COMMANDS: Mapping[str, Sequence[str]] = {
    CLOUD: (sys.executable, "-m", "offboard.cloud_server"),
    WAN: (sys.executable, "-m", "offboard.loadgen", "wan"),
    ROBOT: (sys.executable, "-m", "offboard.loadgen"),
}


@dataclass(frozen=True, slots=True)
class Addresses:
    """HOST:PORT of a server, of its relay, and of the HTTP APIs of both."""

    server: str
    server_http: str
    relay: str
    relay_http: str


class LocalTestbed:
    """Robots --> relay --> server, on free ports of loopback. Robots find the relay of `cloud` at `endpoint`.

    `commands` holds the commands of cloud, relay and robot; a replacement must take the same flags.

    Ctrl-C and SIGTERM raise an exception in the `with` block, which ends the parts. If this process dies,
    the kernel kills the parts. Use the testbed from the main thread only: when the thread that started a
    child ends, the kernel kills the child.
    """

    def __init__(
        self,
        out: Path,
        setups: Mapping[str, Setup] | None = None,
        *,
        ready_s: float = READY_S,
        commands: Mapping[str, Sequence[str]] = COMMANDS,
    ) -> None:
        self.out = out
        self.ready_s = ready_s
        setups = {CLOUD: Setup(), WAN: Setup()} | dict(setups or {})
        ports = iter(_free_ports(4 * len(servers_among(setups))))
        listens = {
            server: Addresses(*(f"127.0.0.1:{next(ports)}" for _ in range(4)))
            for server in servers_among(setups)
        }
        self.cloud_http, self.endpoint = listens[CLOUD].server_http, f"tcp://{listens[CLOUD].relay}"
        self.parts: dict[str, Part] = {}
        for server, at in listens.items():
            flags: dict[str, Any] = {"listen": f"tcp://{at.server}", "http": at.server_http}
            self._add(server, setups, commands, flags, ready="/ready")
            flags = {"listen": at.relay, "to": at.server, "http": at.relay_http}
            self._add(relay_of(server), setups, commands, flags, ready="/health")
        sites = ",".join(
            f"{setups[name].site or name}=tcp://{at.relay}" for name, at in listens.items() if name != CLOUD
        )
        flags = {"cloud": self.endpoint, **({"site": sites} if sites else {})}
        for name in setups:
            if kind_of(name) == ROBOT:
                self._add(name, setups, commands, flags)
        self._relays = {server: RelayClient(at.relay_http) for server, at in listens.items()}
        self._children: dict[str, Child] = {}
        self._cpus: dict[str, float] = {}  # quotas that were changed; they stay when the part starts again
        self._hogs: dict[str, list[Child]] = {}
        self._terminate_before: Any = None

    def __enter__(self) -> Self:
        self._terminate_before = signal.signal(signal.SIGTERM, leave)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        finally:
            signal.signal(signal.SIGTERM, self._terminate_before)

    def start(self, *parts: str) -> None:
        for name in parts or [part for part in self.parts if kind_of(part) != ROBOT]:
            self.start_part(self.parts[name])

    def start_part(self, part: Part) -> Child:
        """Start the part, or start it again if it has ended, and wait until it is ready."""
        assert threading.current_thread() is threading.main_thread(), "children die with the thread"
        assert not self.running(part.name), f"{part.name} is running already"
        with uninterrupted():  # every started child gets into `_children`
            again = part.name in self._children
            child = self._children[part.name] = launch(part, self._log(part.name), again=again)
            child.wait_launched()
        cpus = self._cpus.get(part.name, part.cpus)
        if cpus is not None:
            child.quota = hold(child.process.pid, cpus)
        if part.http is not None:
            wait_ready(child, self.ready_s)
        return child

    def child(self, part: str) -> Child:
        return self._children[part]

    def quota(self, part: str) -> Quota | None:
        """The quota of a running part."""
        return self._children[part].quota

    def running(self, part: str) -> bool:
        return part in self._children and self.exit_code(part) is None

    def exit_code(self, part: str) -> int | None:
        child = self._children[part]
        code = child.process.poll()
        if code is not None:
            child.finish_output()
        return code

    def wait(self, part: str, timeout_s: float | None = None) -> int:
        """Wait for the end of a part and return its exit code.

        OffloadError if it takes longer than `timeout_s`.
        """
        child = self._children[part]
        try:
            code = child.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise OffloadError(f"{part} has not ended after {timeout_s:g} s") from None
        child.let_go()
        return code

    def kill(self, part: str) -> None:
        child = self._children[part]
        self._end_hogs(part)
        child.send(signal.SIGKILL)
        child.process.wait(KILL_S)
        child.let_go()

    def stop(self, part: str) -> None:
        self._end_hogs(part)
        end(self._children[part])

    def pause(self, part: str) -> None:
        child = self._children[part]
        if child.quota is not None:
            child.quota.pause()
        else:
            child.send(signal.SIGSTOP)

    def resume(self, part: str) -> None:
        child = self._children[part]
        if child.quota is not None:
            child.quota.resume()
        else:
            child.send(signal.SIGCONT)

    def set_cpus(self, part: str, cpus: float) -> None:
        child = self._children[part]
        self._cpus[part] = cpus
        if child.quota is None:
            child.quota = hold(child.process.pid, cpus)
        else:
            child.quota.set(cpus)

    def held(self, part: str) -> str | None:
        quota = self._children[part].quota
        if quota is None:
            return None
        return f"{quota.cpus:g} CPU over {quota.period_s * 1e3:g} ms by {quota.kind}"

    def hogs(self, part: str) -> tuple[Child, ...]:
        """The busy processes that compete with a part now."""
        return tuple(self._hogs.get(part, ()))

    def set_hogs(self, part: str, count: int) -> None:
        hogs, quota = self._hogs.setdefault(part, []), self._children[part].quota
        while len(hogs) > count:
            self._end_hog(hogs.pop())
        while len(hogs) < count:
            name = f"{part}-hog-{len(hogs) + 1}"
            hog = Part(name, (sys.executable, "-I", "-S", "-c", HOG))
            with uninterrupted():
                hogs.append(launch(hog, self._log(name), again=False))
                hogs[-1].wait_launched()
            if quota is not None:
                quota.add(hogs[-1].process.pid)

    def set_link(self, server: str | None = None, **changes: Any) -> dict[str, Any]:
        first, *_ = [self._relays[one].set_link(changes) for one in self._servers(server)]
        return first

    def begin_recording(self, server: str) -> None:
        self._relays[server].begin_recording()

    def link(self, server: str = CLOUD) -> dict[str, Any]:
        return self._relays[server].link()

    def reset(self, server: str | None = None) -> None:
        for one in self._servers(server):
            self._relays[one].reset()

    def cut(self, part: str) -> None:  # on loopback all traffic passes through the relays
        for server in servers_behind(part, self._relays):
            self.set_link(server, outage=True)

    def join(self, part: str) -> None:
        for server in servers_behind(part, self._relays):
            self.set_link(server, outage=False)

    def usage(self, part: str) -> Usage:
        leader = self._children[part].process.pid
        members = [path for path in Path("/proc").glob("[0-9]*") if _session(path) == leader]
        try:
            used = Usage(
                memory_bytes=sum(map(_resident_bytes, members)),
                handles=sum(1 for path in members for _ in (path / "fd").iterdir()),
            )
        except OSError as error:  # a worker may end at this moment
            raise OffloadError(f"{part}: memory and handles cannot be read: {error.strerror}") from error
        if not used.memory_bytes:
            raise OffloadError(f"{part}: memory and handles cannot be read: the part has ended")
        return used

    def close(self) -> None:
        """End all parts, in reverse order of their start.

        It takes a bounded time; Ctrl-C does not interrupt it.
        """
        with uninterrupted():
            for part in tuple(self._hogs):
                self._end_hogs(part)
            for child in reversed(self._children.values()):
                end(child)
            self._children.clear()

    def _add(
        self,
        name: str,
        setups: Mapping[str, Setup],
        commands: Mapping[str, Sequence[str]],
        flags: Mapping[str, Any],
        *,
        ready: str = "",
    ) -> None:
        """Add a part; `flags` are those of the testbed, `ready` is the path that says it is up."""
        setup = setups[name]
        command = (*commands[kind_of(name)], *setup.command.split(), *as_flags({**flags, **setup.flags}))
        self.parts[name] = Part(
            name, command, http=flags.get("http"), ready=ready, cpus=setup.cpus, shown=setup.shown
        )

    def _servers(self, server: str | None) -> list[str]:
        return list(self._relays) if server is None else [server]

    def _log(self, name: str) -> Path:
        return self.out / "logs" / f"{name}.log"

    def _end_hogs(self, part: str) -> None:
        for hog in self._hogs.pop(part, []):
            self._end_hog(hog)

    def _end_hog(self, hog: Child) -> None:
        hog.send(signal.SIGKILL)
        hog.process.wait(KILL_S)


def _session(process: Path) -> int | None:
    """The session of a process; each part has its own. None if the process has just ended."""
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[3])
    except OSError:
        return None


def _resident_bytes(process: Path) -> int:
    pages = int((process / "statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _free_ports(count: int) -> list[int]:
    """Different free ports of loopback. All are open at the same time, so that none is returned twice."""
    with contextlib.ExitStack() as stack:
        taken = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [port.getsockname()[1] for port in taken]
