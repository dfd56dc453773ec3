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
from pathlib import Path
from typing import Any

from offboard.common.errors import OffloadError
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.relay_client import RelayClient
from offboard.loadgen.testbed.cpu_quota import hold
from offboard.loadgen.testbed.part_process import Child, Part, end, launch, wait_ready
from offboard.loadgen.testbed.real_testbed import RealTestbed, uninterrupted
from offboard.loadgen.testbed.testbed import (
    CLOUD,
    ROBOT,
    WAN,
    Setup,
    Usage,
    endpoint_flags,
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


class LocalTestbed(RealTestbed):
    """Robots --> relay --> server, on free ports of loopback. Robots find the relay of `cloud` at `endpoint`.

    `commands` holds the commands of cloud, relay and robot; a replacement must take the same flags.

    If this process dies, or the thread that started a part ends, the kernel kills the part.
    `children` are the parts that were started, `hogs` the busy processes that compete with a part.
    """

    def __init__(
        self,
        out: Path,
        setups: Mapping[str, Setup] | None = None,
        *,
        ready_s: float = READY_S,
        commands: Mapping[str, Sequence[str]] = COMMANDS,
    ) -> None:
        super().__init__(out, setups, ready_s)
        servers = servers_among(self._setups)
        ports = iter(_free_ports(4 * len(servers)))
        self.parts: dict[str, Part] = {}
        endpoints = {}
        for server in servers:
            listen, http, relay, relay_http = (f"127.0.0.1:{next(ports)}" for _ in range(4))
            flags = {"listen": f"tcp://{listen}", "http": http}
            self._add(server, commands, flags, ready="/ready")
            flags = {"listen": relay, "to": listen, "http": relay_http}
            self._add(relay_of(server), commands, flags, ready="/health")
            self._relays[server] = RelayClient(relay_http)
            endpoints[server] = f"tcp://{relay}"
        self.endpoint = endpoints[CLOUD]
        for name in self._setups:
            if kind_of(name) == ROBOT:
                self._add(name, commands, endpoint_flags(self._setups, endpoints))
        self.children: dict[str, Child] = {}
        self.hogs: dict[str, list[Child]] = {}
        self._cpus: dict[str, float] = {}  # quotas that were changed; they stay when the part starts again

    def _start(self, name: str) -> None:
        self.start_part(self.parts[name])

    def start_part(self, part: Part) -> Child:
        """Start the part, or start it again if it has ended, and wait until it is ready."""
        assert threading.current_thread() is threading.main_thread(), "children die with the thread"
        assert not self.running(part.name), f"{part.name} is running already"
        with uninterrupted():  # every started child gets into `children`
            again = part.name in self.children
            child = self.children[part.name] = launch(part, self._log(part.name), again=again)
            child.wait_launched()
        cpus = self._cpus.get(part.name, part.cpus)
        if cpus is not None:
            child.quota = hold(child.process.pid, cpus)
        if part.http is not None:
            wait_ready(child, self.ready_s)
        return child

    def running(self, part: str) -> bool:
        return part in self.children and self.exit_code(part) is None

    def exit_code(self, part: str) -> int | None:
        child = self.children[part]
        code = child.process.poll()
        if code is not None:
            child.finish_output()
        return code

    def wait(self, part: str, timeout_s: float | None = None) -> int:
        """Wait for the end of a part and return its exit code; OffloadError if it takes too long."""
        child = self.children[part]
        try:
            code = child.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise OffloadError(f"{part} has not ended after {timeout_s:g} s") from None
        child.let_go()
        return code

    def kill(self, part: str) -> None:
        child = self.children[part]
        self._end_hogs(part)
        child.kill()
        child.let_go()

    def stop(self, part: str) -> None:
        self._end_hogs(part)
        end(self.children[part])

    def pause(self, part: str) -> None:
        child = self.children[part]
        if child.quota is not None:
            child.quota.pause()
        else:
            child.send(signal.SIGSTOP)

    def resume(self, part: str) -> None:
        child = self.children[part]
        if child.quota is not None:
            child.quota.resume()
        else:
            child.send(signal.SIGCONT)

    def set_cpus(self, part: str, cpus: float) -> None:
        child = self.children[part]
        self._cpus[part] = cpus
        if child.quota is None:
            child.quota = hold(child.process.pid, cpus)
        else:
            child.quota.set(cpus)

    def held(self, part: str) -> str | None:
        quota = self.children[part].quota
        if quota is None:
            return None
        return f"{quota.cpus:g} CPU over {quota.period_s * 1e3:g} ms by {quota.kind}"

    def set_hogs(self, part: str, count: int) -> None:
        hogs, quota = self.hogs.setdefault(part, []), self.children[part].quota
        while len(hogs) > count:
            hogs.pop().kill()
        while len(hogs) < count:
            name = f"{part}-hog-{len(hogs) + 1}"
            hog = Part(name, (sys.executable, "-I", "-S", "-c", HOG))
            with uninterrupted():
                hogs.append(launch(hog, self._log(name), again=False))
                hogs[-1].wait_launched()
            if quota is not None:
                quota.add(hogs[-1].process.pid)

    def cut(self, part: str) -> None:  # on loopback all traffic passes through the relays
        for server in servers_behind(part, self._relays):
            self.set_link(server, outage=True)

    def join(self, part: str) -> None:
        for server in servers_behind(part, self._relays):
            self.set_link(server, outage=False)

    def usage(self, part: str) -> Usage:
        leader = self.children[part].process.pid
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
        with uninterrupted():
            for part in tuple(self.hogs):
                self._end_hogs(part)
            for child in reversed(self.children.values()):
                end(child)
            self.children.clear()

    def _add(
        self, name: str, commands: Mapping[str, Sequence[str]], flags: Mapping[str, Any], *, ready: str = ""
    ) -> None:
        """Add a part; `flags` are those of the testbed, `ready` is the path that says it is up."""
        setup = self._setups[name]
        command = (*commands[kind_of(name)], *setup.command.split(), *as_flags({**flags, **setup.flags}))
        self.parts[name] = Part(
            name, command, http=flags.get("http"), ready=ready, cpus=setup.cpus, shown=setup.shown
        )

    def _end_hogs(self, part: str) -> None:
        for hog in self.hogs.pop(part, []):
            hog.kill()


def _session(process: Path) -> int | None:
    """The session of a process; each part has its own. None if the process has just ended."""
    try:
        return os.getsid(int(process.name))
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
