"""What others take of the CPU, from files laid out as a kernel shows them."""

import os
import threading
import time
from pathlib import Path

import pytest

from offboard.common.host import load
from offboard.common.host.load import (
    EVERY_S,
    HURRIED_S,
    LOOKED_UP_EVERY,
    READINGS_MAX,
    TICK_S,
    Load,
    LoadWatch,
)
from tests.unit.test_cpu import Machine

CPUS = os.cpu_count() or 1


class Times:
    """What the process reads of clocks, as the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.own_s = 100.0, 5.0
        monkeypatch.setattr(load.time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(load.time, "process_time", lambda: self.own_s)


@pytest.fixture
def times(monkeypatch: pytest.MonkeyPatch) -> Times:
    return Times(monkeypatch)


class Host:
    """A /proc of a machine without cgroups."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "proc"
        (self.root / "self").mkdir(parents=True)
        self.busy_s(0.0)

    def busy_s(self, seconds: float) -> None:
        """All of it that was not idle, half of it the system's; guests are users already."""
        half = round(seconds / 2 / TICK_S)
        (self.root / "stat").write_text(f"cpu  {half} 0 {half} 99999 500 0 0 0 777 0\ncpu0 1 2 3\n")

    def load(self) -> Load:
        return Load(self.root / "self", self.root)


class Counted(Load):
    """Notes who reads it, and says how often that was."""

    def __init__(self, proc: Path) -> None:
        super().__init__(proc)
        self.read_by: list[threading.Thread] = []

    def share(self, every_s: float = EVERY_S) -> float:  # noqa: ARG002
        self.read_by.append(threading.current_thread())
        return float(len(self.read_by))


def later(times: Times, seconds: float, own_s: float = 0.0) -> None:
    times.now_s += seconds
    times.own_s += own_s


def test_the_share_of_others_is_that_of_what_is_left(tmp_path: Path, times: Times) -> None:
    """Others who take half of what this process leaves are a load of a half, once that lasted."""
    host = Host(tmp_path)
    host.busy_s(50.0)
    one = host.load()
    assert one.share() == 0.0
    total, own = 50.0, 0.25
    for _ in range(60):
        later(times, 0.5, own)
        total += own + 0.5 * (0.5 * CPUS - own)
        host.busy_s(total)
        share = one.share()
    assert share == pytest.approx(0.5, abs=0.01 + TICK_S)


def test_what_this_process_takes_is_no_load(tmp_path: Path, times: Times) -> None:
    """However busy the robot itself is, the load is that of others."""
    host = Host(tmp_path)
    host.busy_s(50.0)
    one = host.load()
    one.share()
    total = 50.0
    for _ in range(20):
        later(times, 0.5, 0.4)
        total += 0.4
        host.busy_s(total)
    assert one.share() == pytest.approx(0.0, abs=2 * TICK_S)


def test_it_is_read_no_more_often_than_it_says(tmp_path: Path, times: Times) -> None:
    """Between two readings the last share is the answer, at no cost."""
    host = Host(tmp_path)
    one = host.load()
    one.share()
    host.busy_s(1000.0)
    later(times, 0.9 * EVERY_S)
    assert one.share() == 0.0
    later(times, 0.2 * EVERY_S)
    assert one.share() > 0.0


def test_the_share_is_that_since_the_reading_before(tmp_path: Path, times: Times) -> None:
    """What was long ago counts for nothing; it never leaves 0 to 1."""
    host = Host(tmp_path)
    one = host.load()
    one.share()
    later(times, EVERY_S)
    host.busy_s(0.25 * CPUS * EVERY_S)
    assert one.share() == pytest.approx(0.25, abs=2 * TICK_S / EVERY_S)
    later(times, EVERY_S)
    host.busy_s(100.0)
    assert one.share() == 1.0
    later(times, EVERY_S)
    assert one.share() == 0.0


def test_where_nothing_is_left_the_last_share_stays(tmp_path: Path, times: Times) -> None:
    """A process that has all the CPU learns nothing of what others would take."""
    host = Host(tmp_path)
    one = host.load()
    one.share()
    later(times, 0.5)
    host.busy_s(100.0)
    before = one.share()
    assert before > 0
    later(times, 0.5, 0.5 * CPUS)
    host.busy_s(1000.0)
    assert one.share() == before


@pytest.mark.parametrize("text", ["", "cpu a b c d\n", "intr 5\n"])
def test_what_cannot_be_read_is_no_load(tmp_path: Path, times: Times, text: str) -> None:
    """A machine without /proc/stat, or with another one, has load 0 and goes on."""
    host = Host(tmp_path)
    (host.root / "stat").write_text(text)
    one = host.load()
    for _ in range(3):
        later(times, 0.5)
        assert one.share() == 0.0


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_in_a_group_with_a_quota_the_cpu_is_the_quota(machine: Machine, times: Times) -> None:
    """Others who take a quarter CPU of a quota of a half are a load of a half."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/robot")
    group = machine.write(point / "robot", cpu_max="50000 100000\n", cpu_stat="usage_usec 6000000\n")
    one = Load(machine.proc, machine.proc)
    assert one.share() == 0.0
    used_us = 6_000_000
    for _ in range(10):
        later(times, 0.5)
        used_us += 125_000
        machine.write(group, cpu_stat=f"usage_usec {used_us}\n")
        share = one.share()
    assert share == pytest.approx(0.5, abs=0.01)


def test_the_capacity_is_what_quota_and_clock_leave(machine: Machine, times: Times, tmp_path: Path) -> None:
    """Of one CPU at full clock, at the next reading; a quota that is given later is found."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/robot")
    group = machine.write(point / "robot", cpu_max="max 100000\n", cpu_stat="usage_usec 6000000\n")
    clocks = [tmp_path / "clocks" / name for name in ("policy0", "policy4")]
    for clock in clocks:
        machine.write(clock)
        (clock / "scaling_max_freq").write_text("2000000\n")
        (clock / "cpuinfo_max_freq").write_text("2000000\n")
    root = machine.proc
    (root / "stat").write_text("cpu  0 0 0 9 5 0 0 0 0 0\n")
    one = Load(machine.proc, root, tmp_path / "clocks")
    assert (one.share(), one.capacity) == (0.0, 1.0)
    machine.write(group, cpu_max="50000 100000\n")
    (clocks[0] / "scaling_max_freq").write_text("1000000\n")
    for _ in range(LOOKED_UP_EVERY):
        later(times, EVERY_S)
        assert one.share() == 0.0
    assert one.capacity == pytest.approx(0.75 * 0.5)
    machine.write(group, cpu_max="400000 100000\n")
    later(times, EVERY_S)
    one.share()
    assert one.capacity == 0.75


def test_what_the_workers_of_this_process_take_is_no_load(tmp_path: Path, times: Times) -> None:
    """Whoever asks says what is his own."""
    host = Host(tmp_path)
    own_s = 5.0
    one = Load(host.root / "self", host.root, own_s=lambda: own_s)
    one.share()
    for n in range(1, 11):
        later(times, EVERY_S)
        own_s = 5.0 + 0.4 * n
        host.busy_s(0.4 * n)
        assert one.share() == pytest.approx(0.0, abs=2 * TICK_S / EVERY_S)


def test_a_group_that_counts_nothing_is_the_sum_of_its_processes(machine: Machine, times: Times) -> None:
    """Quota and count in other hierarchies: CPU times come from /proc/PID/stat, odd names too."""
    limited = machine.mount("cpu", "cgroup", "rw,cpu")
    machine.mount("cpuacct", "cgroup", "rw,cpuacct")
    machine.process("cpuacct", "/")
    machine.process("cpu", "/offboard")
    group = machine.write(limited / "offboard", cpu_cfs_quota_us="50000\n")
    (group / "cpu.cfs_period_us").write_text("100000\n")
    (group / "cgroup.procs").write_text(f"{os.getpid()}\n41\n42\n")  # 42 has just ended
    root = machine.proc.parent / "all"
    (root / "41").mkdir(parents=True)

    def other(seconds: float) -> None:
        ticks = round(seconds / 2 / TICK_S)
        (root / "41" / "stat").write_text(
            f"41 (a busy (one)) R 1 1 1 0 -1 4 0 0 0 0 {ticks} {ticks} 0 0 20\n"
        )

    other(1.0)
    one = Load(machine.proc, root)
    assert one.share() == 0.0
    for n in range(1, 11):
        later(times, 0.5)
        other(1.0 + 0.125 * n)
        share = one.share()
    assert share == pytest.approx(0.5, abs=0.05)


def test_a_watch_reads_in_a_thread_of_its_own() -> None:
    """But for the first look, as nothing is read before; once it is closed nothing is read either."""
    counted = Counted(Path("/proc/self"))
    watch = LoadWatch(counted)
    assert counted.read_by == []
    until = time.monotonic() + 10
    assert watch.latest()[0] == 1
    while watch.latest()[0] < 3:
        assert time.monotonic() < until
        time.sleep(0.01)
    first, second, *_ = counted.read_by
    assert first is threading.current_thread()
    assert counted.read_by.count(first) == 1
    watch.close()
    second.join(10)
    assert not second.is_alive()


def test_a_watch_asks_how_long_to_wait() -> None:
    """Before each reading but the first, with its interval."""
    counted, asked, done = Counted(Path("/proc/self")), [], threading.Event()

    def pause_s(usual_s: float) -> float:
        asked.append(usual_s)
        if len(asked) == 3:
            done.set()
            return 60.0
        return 0.001

    watch = LoadWatch(counted, 7.0, pause_s)
    watch.latest()
    assert done.wait(10)
    time.sleep(0.05)
    assert (asked, watch.latest()[0]) == ([7.0, 7.0, 7.0], 3)
    watch.close()


def test_who_hurries_reads_at_once_and_not_too_often(tmp_path: Path, times: Times) -> None:
    """A load that has just begun is seen before the next reading is due; a shorter time tells nothing."""
    host = Host(tmp_path)
    host.busy_s(50.0)
    one = host.load()
    one.share()
    later(times, 2 * HURRIED_S)
    host.busy_s(50.0 + 2 * HURRIED_S * CPUS)
    assert one.share() == 0.0, "the next reading is not due"
    assert one.share(HURRIED_S) == pytest.approx(1.0, abs=TICK_S / HURRIED_S)
    later(times, HURRIED_S / 2)
    assert one.share(HURRIED_S) == pytest.approx(1.0, abs=TICK_S / HURRIED_S), "it has just been read"


def test_a_watch_that_is_hurried_reads_in_the_callers_thread() -> None:
    """Once it was looked at: before, nobody wants to know."""
    counted = Counted(Path("/proc/self"))
    watch = LoadWatch(counted)
    watch.hurry()
    assert counted.read_by == []
    until = time.monotonic() + 10
    while not watch.latest()[0]:
        assert time.monotonic() < until
        time.sleep(0.01)
    watch.hurry()
    assert threading.current_thread() in counted.read_by
    watch.close()


def test_a_hurried_reading_looks_back_until_it_can_tell(machine: Machine, times: Times) -> None:
    """Under a small quota two of them may be a tick of CPU time apart: what others took is not 0 then."""
    quota, soon_s = 0.1, 1.01 * HURRIED_S
    point = machine.mount("", "cgroup2")
    machine.process("", "/robot")
    group = machine.write(point / "robot", cpu_max=f"{quota * 1e5:.0f} 100000\n")

    def used(seconds: float) -> None:
        machine.write(group, cpu_stat=f"usage_usec {round(seconds * 1e6)}\n")

    used(1.0)
    one = Load(machine.proc)
    one.share()
    for n in range(1, 4):
        later(times, EVERY_S)
        used(1.0 + n * quota * EVERY_S)
        assert one.share() == pytest.approx(1.0, abs=0.01)
    later(times, soon_s)  # the kernel has not counted yet what ran since
    assert one.share(HURRIED_S) == pytest.approx(EVERY_S / (EVERY_S + soon_s), abs=0.01)
    for _ in range(READINGS_MAX):
        later(times, soon_s)
        share = one.share(HURRIED_S)
    assert share == 0.0, "for so long nobody ran"


def test_a_new_quota_is_not_held_against_what_was_before(machine: Machine, times: Times) -> None:
    """Others who took half of what there was are a load of a half, also once there is less."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/robot")
    group = machine.write(point / "robot", cpu_max="100000 100000\n", cpu_stat="usage_usec 1000000\n")
    one = Load(machine.proc)
    one.share()
    for used_us, quota in ((1_250_000, 100_000), (1_500_000, 25_000), (1_562_500, 25_000)):
        later(times, EVERY_S)
        machine.write(group, cpu_max=f"{quota} 100000\n", cpu_stat=f"usage_usec {used_us}\n")
        assert one.share() == pytest.approx(0.5, abs=0.01)
