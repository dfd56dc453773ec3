"""Which clock counts the CPU time of what runs here, and that it counts it."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from offboard.common.host.cpu import Clock, parse_usage, usage_file
from offboard.loadgen.testbed.cpu_quota import CgroupQuota, hold

ROOT = Path(__file__).parents[2]
TOLERANCE_S = 0.05  # a process's start and end, and what else the kernel charges to it
SHORT_TOLERANCE_S = 0.0005  # a tick is 1 to 10 ms
BURNT_S = 0.3
DOCKER = "/docker/48d9"


class Machine:
    """A tree of cgroups in a folder, and the /proc of one process there."""

    def __init__(self, folder: Path) -> None:
        self.proc, self.sys = folder / "proc", folder / "cgroup"
        self.proc.mkdir()
        self._own: list[str] = []
        self._mounts: list[str] = ["31 23 0:28 / /sys/fs/cgroup rw,relatime - tmpfs tmpfs rw,mode=755"]

    def process(self, controllers: str, path: str) -> None:
        self._own.append(f"{len(self._own)}:{controllers}:{path}\n")
        (self.proc / "cgroup").write_text("".join(self._own))

    def mount(self, name: str, kind: str, options: str = "rw", *, root: str = "/") -> Path:
        point = self.sys / name
        point.mkdir(parents=True)
        self._mounts.append(f"32 31 0:29 {root} {point} rw,relatime shared:7 - {kind} cgroup {options}")
        (self.proc / "mountinfo").write_text("\n".join(self._mounts) + "\n")
        return point

    @staticmethod
    def write(folder: Path, **files: str) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name.replace("_", ".", 1)).write_text(text)
        return folder


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_version_2_counts_the_group_with_the_quota(machine: Machine) -> None:
    """The process's own group where that has a quota."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/user.slice/robot")
    machine.write(point / "user.slice", cpu_max="max 100000\n")
    own = machine.write(point / "user.slice/robot", cpu_max="20000 100000\n")
    assert usage_file(machine.proc) == own / "cpu.stat"


def test_a_group_without_a_quota_does_not_count(machine: Machine) -> None:
    """An unlimited group, and a root that has no such file, leave the process's own clock."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/user.slice/session")
    machine.write(point / "user.slice", cpu_max="max 100000\n")
    machine.write(point / "user.slice/session", cpu_max="max 100000\n")
    assert usage_file(machine.proc) is None


def test_a_quota_further_out_holds_the_process_too(machine: Machine) -> None:
    """A group without a quota inside one that has it: the outer one's time counts, not that around it."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/pod/container/init")
    machine.write(point / "pod", cpu_max="90000 100000\n")
    limited = machine.write(point / "pod/container", cpu_max="2000 10000\n")
    machine.write(point / "pod/container/init", cpu_max="max 10000\n")
    assert usage_file(machine.proc) == limited / "cpu.stat"


@pytest.mark.parametrize("path", [DOCKER, "/"], ids=["host's path", "path of its own namespace"])
def test_in_a_container_the_group_is_the_mount(machine: Machine, path: str) -> None:
    """/proc/self/cgroup may name the host's path, of which the container sees the last part only."""
    machine.process("cpuacct", path)
    machine.process("cpu", path)
    machine.process("name=systemd", path)
    machine.process("", path)
    machine.mount("unified", "cgroup2", root=path)
    limited = machine.mount("cpu", "cgroup", "rw,cpu", root=path)
    counted = machine.mount("cpuacct", "cgroup", "rw,cpuacct", root=path)
    machine.write(limited, cpu_cfs_quota_us="2000\n")
    assert usage_file(machine.proc) == counted / "cpuacct.usage"
    machine.write(limited, cpu_cfs_quota_us="-1\n")
    assert usage_file(machine.proc) is None


def test_version_1_with_both_controllers_in_one_hierarchy(machine: Machine) -> None:
    """cpu,cpuacct: quota and usage are in one folder."""
    point = machine.mount("cpu,cpuacct", "cgroup", "rw,cpu,cpuacct")
    machine.process("cpu,cpuacct", "/offboard-1-2")
    group = machine.write(point / "offboard-1-2", cpu_cfs_quota_us="2000\n")
    machine.write(point, cpu_cfs_quota_us="-1\n")
    assert usage_file(machine.proc) == group / "cpuacct.usage"


def test_version_1_groups_of_two_paths_are_not_one(machine: Machine) -> None:
    """A quota in one hierarchy, the CPU time of the whole machine in the other: the process's own clock."""
    limited = machine.mount("cpu", "cgroup", "rw,cpu")
    machine.mount("cpuacct", "cgroup", "rw,cpuacct")
    machine.process("cpuacct", "/")
    machine.process("cpu", "/offboard-1-2")
    machine.write(limited / "offboard-1-2", cpu_cfs_quota_us="2000\n")
    assert usage_file(machine.proc) is None


@pytest.mark.parametrize("text", ["", "nonsense\n", "0::/elsewhere\n"])
def test_what_cannot_be_understood_is_no_group(machine: Machine, text: str) -> None:
    """A /proc without cgroups, or of another form, leaves the process's own clock."""
    machine.write(machine.mount("", "cgroup2", root="/docker"), cpu_max="2000 10000\n")
    assert usage_file(machine.proc) is None
    (machine.proc / "cgroup").write_text(text)
    assert usage_file(machine.proc) is None


def test_both_versions_are_read() -> None:
    """Microseconds in version 2, nanoseconds in version 1."""
    assert parse_usage(b"usage_usec 1500000\nuser_usec 1\nsystem_usec 2\n") == 1.5
    assert parse_usage(b"2500000000\n") == 2.5
    for text in (b"", b"user_usec 5\n", b"usage_usec\n", b"usage_usec "):
        with pytest.raises(ValueError, match="invalid literal"):
            parse_usage(text)


def test_the_clock_follows_its_file(tmp_path: Path) -> None:
    """It gives the group's seconds, also of a group that this process was put into late."""
    file = tmp_path / "cpuacct.usage"
    for first_s in (0, 1_000_000):  # less than this process has used so far, and more
        file.write_text(f"{first_s}000000000\n")
        clock = Clock(file)
        assert clock.used_s() == pytest.approx(first_s, abs=TOLERANCE_S)
        file.write_text(f"{first_s + 7}000000000\n")
        assert clock.used_s() == pytest.approx(first_s + 7, abs=1e-6)
        clock.close()


@pytest.mark.parametrize("text", ["", "nonsense", "3000000000\n"], ids=["empty", "nonsense", "set back"])
def test_a_file_that_fails_leaves_the_processs_own_clock(tmp_path: Path, text: str) -> None:
    """From then on the clock goes on by this process's own time, and never back."""
    file = tmp_path / "cpuacct.usage"
    file.write_text("900000000000\n")
    clock = Clock(file)
    reads = [clock.used_s()]
    file.write_text(text)
    reads.append(clock.used_s())
    assert reads == pytest.approx([900, 900], abs=TOLERANCE_S)
    assert reads[0] < reads[1]
    before_s, own_before_s = clock.used_s(), time.process_time()
    while time.process_time() - own_before_s < 2 * TOLERANCE_S:
        pass
    own_s = time.process_time() - own_before_s
    assert clock.used_s() - before_s == pytest.approx(own_s, abs=TOLERANCE_S / 2)
    clock.close()


def test_without_a_file_it_is_the_processs_own_clock(tmp_path: Path) -> None:
    """No group, or one that is gone before it is opened."""
    for clock in (Clock(None), Clock(tmp_path / "gone")):
        assert clock.used_s() == pytest.approx(time.process_time(), abs=TOLERANCE_S)


FORKED = """
import os, sys
from offboard.common.host import cpu
cpu.used_s()
cpu._clock._lock.acquire()  # as another thread might at that moment
cpu._lock.acquire()
if os.fork() == 0:
    print("forked", cpu.used_s() >= 0, flush=True)
    os._exit(0)
os.wait()
"""


def test_a_forked_process_looks_anew() -> None:
    """A process forked while another thread reads the clock does not hang in it."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, cwd=ROOT, timeout=8)
    assert done.stdout == "forked True\n", done.stderr


# Waits until it is held, then measures a process that it starts, which is in the same group, and some short
# runs of its own that ask no clock: how much more its clock shows than the process's does.
PAIR = f"""
import statistics, subprocess, sys, time
from offboard.common.host import cpu
burner = "import time\\nwhile time.process_time() < {BURNT_S}: pass\\nprint(time.process_time())"
sys.stdin.readline()
print(cpu.usage_file(cpu.SELF))
before_s, own_before_s = cpu.used_s(), time.process_time()
burnt_s = float(subprocess.check_output([sys.executable, "-S", "-c", burner]))
used_s, own_s = cpu.used_s() - before_s, time.process_time() - own_before_s
more = []
for _ in range(40):
    time.sleep(0.003)
    before_s, own_before_s = cpu.used_s(), time.process_time()
    sum(range(100_000))
    after_s, own_after_s = cpu.used_s(), time.process_time()
    more.append(after_s - before_s - (own_after_s - own_before_s))
print(used_s, own_s, burnt_s, statistics.median(more), flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def pair() -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", PAIR], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        yield process
        process.kill()


@contextlib.contextmanager
def counted(quota: CgroupQuota) -> Iterator[bool]:
    """Put the held process into a group of cpuacct with the quota's path, where that is another hierarchy.

    Gives False where there is no telling.
    """
    if quota.kind == "cgroup v2" or (quota._group / "cpuacct.usage").exists():
        yield True
        return
    group = Path("/sys/fs/cgroup/cpuacct", quota._group.relative_to("/sys/fs/cgroup/cpu"))
    try:
        group.mkdir()
    except OSError:
        yield False
        return
    try:
        (group / "cgroup.procs").write_text(str(quota.pid))
        yield True
    finally:
        for pid in (group / "cgroup.procs").read_text().split():
            (group.parent / "cgroup.procs").write_text(pid)
        group.rmdir()


def ask(pair: subprocess.Popen[str]) -> tuple[str, list[float]]:
    """The file that it reads, and CPU seconds: by its clock, its own, the burner's; more in a short run."""
    assert pair.stdin is not None
    assert pair.stdout is not None
    pair.stdin.write("go\n")
    pair.stdin.flush()
    return pair.stdout.readline().strip(), [float(number) for number in pair.stdout.readline().split()]


def test_a_process_under_a_quota_counts_its_whole_group(pair: subprocess.Popen[str]) -> None:
    """Put into a group after it was started, it counts what another process of the group burns, and its own
    short runs to their end and not to the last tick before it."""
    with hold(pair.pid, 0.9) as quota:
        if not isinstance(quota, CgroupQuota):
            pytest.skip("no cgroup with a CPU controller may be made here")
        with counted(quota) as possible:
            if not possible:
                pytest.skip("no cgroup that counts CPU time may be made here")
            file, (used_s, own_s, burnt_s, more_s) = ask(pair)
    print(f"{quota.kind}, {file}: {used_s:.4f} s used, {own_s:.4f} s its own, {burnt_s:.4f} s burnt")
    print(f"a short run: {more_s * 1e3:.3f} ms more than its own time")
    assert burnt_s >= BURNT_S
    assert used_s == pytest.approx(own_s + burnt_s, abs=TOLERANCE_S)
    assert more_s == pytest.approx(0, abs=SHORT_TOLERANCE_S)


def test_a_process_without_a_quota_counts_itself(pair: subprocess.Popen[str]) -> None:
    """Where no quota holds it, what another process burns is not its own."""
    if usage_file(Path(f"/proc/{pair.pid}")) is not None:
        pytest.skip("these tests are themselves under a CPU quota")
    _, (used_s, own_s, burnt_s, _) = ask(pair)
    print(f"{used_s:.4f} s used, {own_s:.4f} s its own, {burnt_s:.4f} s burnt")
    assert used_s == pytest.approx(own_s, abs=TOLERANCE_S)
    assert used_s < burnt_s
