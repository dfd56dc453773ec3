"""CPU quotas for processes: limits one with a cgroup if we may make one, else by stopping and continuing it.

Docker limits its containers itself (`container_part.quota`).
"""

import atexit
import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from offboard.common.errors import ConfigError

CPUS_MIN = 0.05
CPUS_MAX = 64.0
CGROUP_PERIOD_S = 0.010  # the kernel's default of 100 ms stops the process for 75 ms at a time
CGROUP_QUOTA_S_MIN = 0.001  # the kernel refuses less
SIGNAL_PERIOD_S = 0.020
SIGNAL_STEP_S = 0.0005  # shortest time between two looks of the controller
PERIODS_MADE_UP = 3  # a late controller makes up for at most this many periods
CLOSE_WAIT_S = 1.0


class Quota:
    """The CPU quota of one process; `close` releases the process.

    `cpus` and `period_s` are the values in force, read back from the kernel if the kernel keeps them.
    """

    kind: str
    cpus: float
    period_s: float

    def __init__(self, pid: int) -> None:
        self.pid = pid
        # A pidfd stays valid for this process, even if its pid is used again. None: closed.
        self._process: int | None = os.pidfd_open(pid)
        atexit.register(self.close)

    def set(self, cpus: float) -> None:
        """Change the quota to this number of CPUs."""
        raise NotImplementedError

    def add(self, pid: int) -> None:
        """Let another process share the quota, until `close`."""
        raise NotImplementedError

    def pause(self) -> None:
        """Stop the process until `resume`."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._signal(signal.SIGCONT)

    def close(self) -> None:
        """Let the process run without a quota. Safe to call twice, and after the end of the process."""
        if self._process is not None:
            self._signal(signal.SIGCONT)
            os.close(self._process)
            self._process = None
            atexit.unregister(self.close)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._process, number)


def hold(pid: int, cpus: float) -> Quota:
    """Limit the process, with all its threads together, to `cpus` CPUs from now on."""
    check_cpus(cpus)
    for place in _places(pid):
        try:
            return CgroupQuota(pid, cpus, place)
        except OSError:  # we may not write here, or there is no CPU controller: try the next place
            continue
    return SignalQuota(pid, cpus)


def check_cpus(cpus: float) -> None:
    if not CPUS_MIN <= cpus <= CPUS_MAX:
        raise ConfigError(f"CPU quota {cpus} is not a number from {CPUS_MIN} to {CPUS_MAX:g}")


def cgroup_us(cpus: float) -> tuple[int, int]:
    """Quota and period of a cgroup in microseconds: 10 ms, or a longer period if the kernel needs it."""
    check_cpus(cpus)
    period_us = round(1e6 * max(CGROUP_PERIOD_S, CGROUP_QUOTA_S_MIN / cpus))
    return round(cpus * period_us), period_us


@dataclass(frozen=True, slots=True)
class Place:
    """Where a cgroup may be made: its version, the process's current group, the parent of the new group."""

    version: int
    home: Path
    parent: Path


class CgroupQuota(Quota):
    """A quota by the kernel, in a new group at `place`; `close` moves the process back to its own group."""

    def __init__(self, pid: int, cpus: float, place: Place) -> None:
        self.kind = f"cgroup v{place.version}"
        self._place = place
        self._group = place.parent / f"offboard-{os.getpid()}-{pid}"
        _remove_left_behind(place.parent)
        self._group.mkdir()
        try:
            self.set(cpus)
            self.add(pid)
            super().__init__(pid)
        except OSError:
            self._remove()
            raise

    def set(self, cpus: float) -> None:
        quota_us, period_us = cgroup_us(cpus)
        if self._place.version == 2:
            (self._group / "cpu.max").open("r+").close()  # fails if the controller is not delegated to us
            (self._group / "cpu.max").write_text(f"{quota_us} {period_us}")
            quota_us, period_us = map(int, (self._group / "cpu.max").read_text().split())
        else:
            (self._group / "cpu.cfs_period_us").write_text(str(period_us))
            (self._group / "cpu.cfs_quota_us").write_text(str(quota_us))
            quota_us = int((self._group / "cpu.cfs_quota_us").read_text())
            period_us = int((self._group / "cpu.cfs_period_us").read_text())
        self.cpus, self.period_s = quota_us / period_us, period_us / 1e6

    def add(self, pid: int) -> None:
        (self._group / "cgroup.procs").write_text(str(pid))

    def close(self) -> None:
        if self._process is not None:
            super().close()
            self._remove()

    def _remove(self) -> None:
        """Move the processes back and remove the group; a dead process may stay in it for a moment."""
        end = time.monotonic() + CLOSE_WAIT_S
        while self._group.exists() and time.monotonic() < end:
            with contextlib.suppress(OSError):
                for pid in (self._group / "cgroup.procs").read_text().split():
                    (self._place.home / "cgroup.procs").write_text(pid)
            try:
                self._group.rmdir()
            except OSError:
                time.sleep(SIGNAL_STEP_S)


class SignalQuota(Quota):
    """A quota by a thread, which stops the process until the next period once it has used its CPU time.

    As in the kernel, CPU time beyond the share is taken off the next periods, and an unused share is lost.
    If this process is killed, the limited process may stay stopped, so it must be started in such a way that
    it dies too (`part_process`).
    """

    kind = "stop-continue"
    period_s = SIGNAL_PERIOD_S

    def __init__(self, pid: int, cpus: float) -> None:
        super().__init__(pid)
        self.cpus = cpus
        self._used_s = {pid: 0.0}  # last known CPU time of every process that shares the quota
        self._sharing: list[int] = []  # pidfds of the added processes
        self._lock = threading.Lock()
        self._spent = False
        self._paused = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._control, name=f"quota-{pid}", daemon=True)
        self._thread.start()

    def set(self, cpus: float) -> None:
        check_cpus(cpus)
        self.cpus = cpus

    def add(self, pid: int) -> None:
        with self._lock:
            self._sharing.append(os.pidfd_open(pid))
            self._used_s[pid] = 0.0
            if self._spent or self._paused:
                signal.pidfd_send_signal(self._sharing[-1], signal.SIGSTOP)

    def pause(self) -> None:
        self._set(paused=True)

    def resume(self) -> None:
        self._set(paused=False)

    def close(self) -> None:
        self._closing.set()
        self._thread.join(CLOSE_WAIT_S)
        super().close()
        while self._sharing:
            os.close(self._sharing.pop())

    def _control(self) -> None:
        with contextlib.suppress(OSError):  # the process is gone
            credit_s, used_s, filled_s = 0.0, self._used(), time.monotonic()
            while not self._closing.is_set():
                now_s = time.monotonic()
                elapsed_s = min(now_s - filled_s, PERIODS_MADE_UP * SIGNAL_PERIOD_S)
                credit_s, filled_s = min(credit_s, 0.0) + self.cpus * elapsed_s, now_s
                self._set(spent=credit_s <= 0)
                while (
                    left_s := now_s + SIGNAL_PERIOD_S - time.monotonic()
                ) > 0 and not self._closing.is_set():
                    self._closing.wait(left_s if self._spent else min(left_s, max(credit_s, SIGNAL_STEP_S)))
                    used_before_s, used_s = used_s, self._used()
                    credit_s -= used_s - used_before_s
                    if credit_s <= 0:
                        self._set(spent=True)

    def _used(self) -> float:
        """CPU seconds of all processes that share the quota; OSError once the limited process is gone."""
        for pid in tuple(self._used_s):
            try:
                self._used_s[pid] = time.clock_gettime((~pid << 3) | 2)  # the id of its CPU clock
            except OSError:
                if pid == self.pid:
                    raise
        return sum(self._used_s.values())

    def _set(self, spent: bool | None = None, paused: bool | None = None) -> None:
        """Change the reasons to stop the process, and stop or continue it if that makes a difference."""
        with self._lock:
            stopped = self._spent or self._paused
            self._spent = self._spent if spent is None else spent
            self._paused = self._paused if paused is None else paused
            if stopped != (self._spent or self._paused):
                self._signal(signal.SIGCONT if stopped else signal.SIGSTOP)

    def _signal(self, number: signal.Signals) -> None:
        super()._signal(number)
        for process in self._sharing:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, number)


def _places(pid: int) -> Iterator[Place]:
    """The places where a group may be made, the most likely ones first.

    Version 2 allows no processes in a group that has children, so there the groups above are tried too.
    """
    mounts = [line.split()[1:4] for line in Path("/proc/self/mounts").read_text().splitlines()]
    for line in Path(f"/proc/{pid}/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        for mount, filesystem, options in mounts:
            home = Path(mount + path)
            if filesystem == "cgroup" and "cpu" in controllers.split(",") and "cpu" in options.split(","):
                yield Place(1, home, home)
            elif filesystem == "cgroup2" and controllers == "":
                for parent in (home, *home.parents):
                    if parent.is_relative_to(mount):
                        yield Place(2, home, parent)


def _remove_left_behind(parent: Path) -> None:
    """Remove empty groups that a killed process left behind."""
    for group in parent.glob("offboard-*"):
        if not Path("/proc", group.name.split("-")[1]).exists():
            with contextlib.suppress(OSError):
                group.rmdir()
