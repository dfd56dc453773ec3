"""The load of other programs and the capacity of the CPU, from files as a kernel shows them."""

import os
from pathlib import Path

import pytest

from offboard.common import load
from offboard.common.load import (
    EVERY_S,
    HURRIED_S,
    LOOKED_UP_EVERY,
    READINGS_MAX,
    TICK_S,
    Load,
)
from tests.cgroups import Machine

CPUS = 2
OWN = {1}  # of the CPUs 0 and 1


class Times:
    """The clocks that the process reads; the test sets them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.own_s = 100.0, 5.0
        monkeypatch.setattr(load.time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(load.time, "process_time", lambda: self.own_s)


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """The CPUs that this process may use, of a machine with CPUS of them; the test may change the set."""
    cpus = set(range(CPUS))
    monkeypatch.setattr(load.os, "cpu_count", lambda: CPUS)
    monkeypatch.setattr(load.os, "sched_getaffinity", lambda _: set(cpus))
    return cpus


@pytest.fixture
def times(monkeypatch: pytest.MonkeyPatch) -> Times:
    return Times(monkeypatch)


class Host:
    """A /proc of a machine without cgroups."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "proc"
        (self.root / "self").mkdir(parents=True)
        self.busy_s(0.0)

    def busy_s(self, seconds: float, on: int = 0) -> None:
        """CPU seconds of all processes, half in the kernel, all on one CPU.

        The time of guests is part of the user time.
        """
        half = round(seconds / 2 / TICK_S)
        busy = f"{half} 0 {half} 99999 500 0 0 0 777 0"
        each = [f"cpu{number} {busy if number == on else '0 ' * 10}" for number in range(CPUS)]
        (self.root / "stat").write_text("\n".join([f"cpu  {busy}", *each, "intr 5\n"]))

    def load(self) -> Load:
        return Load(self.root / "self", self.root)


def later(times: Times, seconds: float, own_s: float = 0.0) -> None:
    times.now_s += seconds
    times.own_s += own_s


def test_the_load_is_the_share_of_what_this_process_leaves(tmp_path: Path, times: Times) -> None:
    """If others take half of the CPU that this process leaves, the load is 0.5."""
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


def test_the_work_of_this_process_is_no_load(tmp_path: Path, times: Times) -> None:
    """If this process alone is busy, the load is 0."""
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


def test_the_load_is_read_once_per_interval(tmp_path: Path, times: Times) -> None:
    """Before the interval is over, `share` returns the last reading."""
    host = Host(tmp_path)
    one = host.load()
    one.share()
    host.busy_s(1000.0)
    later(times, 0.9 * EVERY_S)
    assert one.share() == 0.0
    later(times, 0.2 * EVERY_S)
    assert one.share() > 0.0


def test_the_load_covers_the_time_since_the_last_reading(tmp_path: Path, times: Times) -> None:
    """Earlier times do not count, and the load stays between 0 and 1."""
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


def test_a_process_that_uses_the_whole_cpu_keeps_the_last_load(tmp_path: Path, times: Times) -> None:
    """As long as it leaves nothing to others, their load cannot be measured."""
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


@pytest.mark.parametrize(("on", "expected"), [(0, 0.0), (1, 0.5)])
def test_only_the_cpus_that_this_process_may_use_count(
    tmp_path: Path, times: Times, allowed: set[int], on: int, expected: float
) -> None:
    """Other programs are load on a CPU of this process, and none on another CPU."""
    allowed.intersection_update(OWN)
    host = Host(tmp_path)
    one = host.load()
    one.share()
    for n in range(1, 11):
        later(times, EVERY_S)
        host.busy_s(0.5 * EVERY_S * n, on)
        assert one.share() == pytest.approx(expected, abs=2 * TICK_S / EVERY_S)
    assert one.capacity == 1.0


def test_other_cpus_are_measured_anew(tmp_path: Path, times: Times, allowed: set[int]) -> None:
    """If this process moves to another CPU, what that CPU did before is no load."""
    allowed.intersection_update(OWN)
    host = Host(tmp_path)
    host.busy_s(50.0, on=0)
    one = host.load()
    one.share()
    allowed.symmetric_difference_update({0, 1})
    later(times, EVERY_S)
    assert one.share() == 0.0
    later(times, EVERY_S)
    host.busy_s(50.0 + 0.25 * EVERY_S, on=0)
    assert one.share() == pytest.approx(0.25, abs=2 * TICK_S / EVERY_S)


def test_all_lines_of_a_large_machine_are_read(
    tmp_path: Path, times: Times, allowed: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last of 256 CPUs counts too."""
    monkeypatch.setattr(load.os, "cpu_count", lambda: 256)
    allowed.clear()
    allowed.add(255)
    host = Host(tmp_path)

    def busy(ticks: int) -> None:
        lines = [f"cpu{n} {10**12} {10**12} {10**12} {10**12} 5 0 0 0 0 0" for n in range(255)]
        (host.root / "stat").write_text(
            "\n".join(["cpu 9 9 9 9 9 9 9 9 9 9", *lines, f"cpu255 {ticks} 0 0 9 5"])
        )

    busy(0)
    one = host.load()
    one.share()
    later(times, EVERY_S)
    busy(round(0.5 * EVERY_S / TICK_S))
    assert one.share() == pytest.approx(0.5, abs=2 * TICK_S / EVERY_S)


@pytest.mark.parametrize("text", ["", "cpu a b c d\n", "intr 5\n"])
def test_an_unreadable_proc_stat_means_no_load(tmp_path: Path, times: Times, text: str) -> None:
    """If /proc/stat is empty or has another form, the load is 0 and nothing is raised."""
    host = Host(tmp_path)
    (host.root / "stat").write_text(text)
    one = host.load()
    for _ in range(3):
        later(times, 0.5)
        assert one.share() == 0.0


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_under_a_quota_the_load_is_a_share_of_the_quota(machine: Machine, times: Times) -> None:
    """If others use 0.25 CPUs of a quota of 0.5 CPUs, the load is 0.5."""
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


def test_quota_and_clock_limit_lower_the_capacity(machine: Machine, times: Times, tmp_path: Path) -> None:
    """Both multiply, also if they are set after the first reading."""
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


def test_the_work_of_worker_processes_is_no_load(tmp_path: Path, times: Times) -> None:
    """CPU time that `own_s` reports does not count as load."""
    host = Host(tmp_path)
    own_s = 5.0
    one = Load(host.root / "self", host.root, own_s=lambda: own_s)
    one.share()
    for n in range(1, 11):
        later(times, EVERY_S)
        own_s = 5.0 + 0.4 * n
        host.busy_s(0.4 * n)
        assert one.share() == pytest.approx(0.0, abs=2 * TICK_S / EVERY_S)


def test_a_group_without_a_usage_file_is_summed_over_its_processes(machine: Machine, times: Times) -> None:
    """Then the CPU times come from /proc/PID/stat, also for processes with brackets in their names."""
    limited = machine.mount("cpu", "cgroup", "rw,cpu")
    machine.mount("cpuacct", "cgroup", "rw,cpuacct")
    machine.process("cpuacct", "/")
    machine.process("cpu", "/offboard")
    group = machine.write(limited / "offboard", cpu_cfs_quota_us="50000\n")
    (group / "cpu.cfs_period_us").write_text("100000\n")
    own = os.getpid()  # in a container it is as small as any number written here
    busy, ended = own + 1, own + 2
    (group / "cgroup.procs").write_text(f"{own}\n{busy}\n{ended}\n")
    root = machine.proc.parent / "all"
    (root / str(busy)).mkdir(parents=True)

    def other(seconds: float) -> None:
        ticks = round(seconds / 2 / TICK_S)
        (root / str(busy) / "stat").write_text(
            f"{busy} (a busy (one)) R 1 1 1 0 -1 4 0 0 0 0 {ticks} {ticks} 0 0 20\n"
        )

    other(1.0)
    one = Load(machine.proc, root)
    assert one.share() == 0.0
    for n in range(1, 11):
        later(times, 0.5)
        other(1.0 + 0.125 * n)
        share = one.share()
    assert share == pytest.approx(0.5, abs=0.05)


def test_a_hurried_reading_comes_early_but_not_too_early(tmp_path: Path, times: Times) -> None:
    """It sees a load that has just begun, but not within HURRIED_S of the last reading."""
    host = Host(tmp_path)
    host.busy_s(50.0)
    one = host.load()
    one.share()
    later(times, 2 * HURRIED_S)
    host.busy_s(50.0 + 2 * HURRIED_S * CPUS)
    assert one.share() == 0.0, "a usual reading is not due yet"
    assert one.share(HURRIED_S) == pytest.approx(1.0, abs=TICK_S / HURRIED_S)
    later(times, HURRIED_S / 2)
    assert one.share(HURRIED_S) == pytest.approx(1.0, abs=TICK_S / HURRIED_S), (
        "the last reading is too recent"
    )


def test_a_hurried_reading_looks_back_far_enough(machine: Machine, times: Times) -> None:
    """Under a small quota, two hurried readings are less than one kernel tick apart; older ones help."""
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
    later(times, soon_s)  # the kernel has not counted this time yet
    assert one.share(HURRIED_S) == pytest.approx(EVERY_S / (EVERY_S + soon_s), abs=0.01)
    for _ in range(READINGS_MAX):
        later(times, soon_s)
        share = one.share(HURRIED_S)
    assert share == 0.0, "nobody used the CPU since the oldest reading"


def test_a_new_quota_does_not_change_the_load_before_it(machine: Machine, times: Times) -> None:
    """If others always use half of what is there, the load stays 0.5 while the quota changes."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/robot")
    group = machine.write(point / "robot", cpu_max="100000 100000\n", cpu_stat="usage_usec 1000000\n")
    one = Load(machine.proc)
    one.share()
    for used_us, quota in ((1_250_000, 100_000), (1_500_000, 25_000), (1_562_500, 25_000)):
        later(times, EVERY_S)
        machine.write(group, cpu_max=f"{quota} 100000\n", cpu_stat=f"usage_usec {used_us}\n")
        assert one.share() == pytest.approx(0.5, abs=0.01)
