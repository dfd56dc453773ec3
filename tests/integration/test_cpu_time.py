"""CPU time under a real CPU quota, in processes of their own."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from offboard.common.cpu_time import quota_group, usage_file
from offboard.loadgen.testbed.cpu_quota import CgroupQuota, hold

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
TOLERANCE_S = 0.05  # CPU time of starting and ending a process
SHORT_TOLERANCE_S = 0.0005  # a tick is 1 to 10 ms
BURNT_S = 0.3

# Waits until it is under its quota. Then it starts a process, which is in the same group, and measures both.
# After that it computes for short times, and measures how much more its clock shows than the process used.
PAIR = f"""
import statistics, subprocess, sys, time
from offboard.common import cpu_time
from offboard.common.cpu_time import SELF, usage_file
burner = "import time\\nwhile time.process_time() < {BURNT_S}: pass\\nprint(time.process_time())"
sys.stdin.readline()
print(usage_file(SELF))
before_s, own_before_s = cpu_time.used_s(), time.process_time()
burnt_s = float(subprocess.check_output([sys.executable, "-S", "-c", burner]))
used_s, own_s = cpu_time.used_s() - before_s, time.process_time() - own_before_s
more = []
for _ in range(40):
    time.sleep(0.003)
    before_s, own_before_s = cpu_time.used_s(), time.process_time()
    sum(range(100_000))
    after_s, own_after_s = cpu_time.used_s(), time.process_time()
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
    """Make sure that a group counts the CPU time of the process under the quota; False if none can.

    If cpuacct is a hierarchy of its own, the process is put into a group there with the quota's path.
    """
    limited = quota_group(Path(f"/proc/{quota.pid}"))
    assert limited is not None
    if limited.usage is not None:
        yield True
        return
    group = Path("/sys/fs/cgroup/cpuacct", limited.folder.relative_to("/sys/fs/cgroup/cpu"))
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
    """The usage file of the process, and its figures in CPU seconds.

    These are: by its clock, its own, those of the process that it started, and the excess in a short run.
    """
    assert pair.stdin is not None
    assert pair.stdout is not None
    pair.stdin.write("go\n")
    pair.stdin.flush()
    return pair.stdout.readline().strip(), [float(number) for number in pair.stdout.readline().split()]


def test_a_process_under_a_quota_counts_its_whole_group(pair: subprocess.Popen[str]) -> None:
    """The clock counts other processes of the group, and resolves runs shorter than the kernel's tick."""
    with contextlib.closing(hold(pair.pid, 0.9)) as quota:
        if not isinstance(quota, CgroupQuota):
            pytest.skip("this machine does not let us make a cgroup with a CPU quota")
        with counted(quota) as possible:
            if not possible:
                pytest.skip("this machine does not let us make a cgroup that counts CPU time")
            file, (used_s, own_s, burnt_s, more_s) = ask(pair)
    print(f"{quota.kind}, {file}: {used_s:.4f} s used, {own_s:.4f} s its own, {burnt_s:.4f} s burnt")
    print(f"a short run: {more_s * 1e3:.3f} ms more than its own time")
    assert burnt_s >= BURNT_S
    assert used_s == pytest.approx(own_s + burnt_s, abs=TOLERANCE_S)
    assert more_s == pytest.approx(0, abs=SHORT_TOLERANCE_S)


def test_a_process_without_a_quota_counts_itself(pair: subprocess.Popen[str]) -> None:
    """Without a quota, the clock does not count the CPU time of another process."""
    if usage_file(Path(f"/proc/{pair.pid}")) is not None:
        pytest.skip("the tests themselves run under a CPU quota")
    _, (used_s, own_s, burnt_s, _) = ask(pair)
    print(f"{used_s:.4f} s used, {own_s:.4f} s its own, {burnt_s:.4f} s burnt")
    assert used_s == pytest.approx(own_s, abs=TOLERANCE_S)
    assert used_s < burnt_s
