"""The clock of CPU time: what it counts, and when it falls back to the time of this process."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from offboard.common.cpu_time import Clock

ROOT = Path(__file__).parents[2]
TOLERANCE_S = 0.05  # CPU time of starting and ending a process


def test_the_clock_follows_its_file(tmp_path: Path) -> None:
    """It shows the seconds of the group, even if this process joined the group late."""
    file = tmp_path / "cpuacct.usage"
    for first_s in (0, 1_000_000):  # less and more than this process has used so far
        file.write_text(f"{first_s}000000000\n")
        clock = Clock(file)
        assert clock.used_s() == pytest.approx(first_s, abs=TOLERANCE_S)
        file.write_text(f"{first_s + 7}000000000\n")
        assert clock.used_s() == pytest.approx(first_s + 7, abs=1e-6)
        clock.close()


@pytest.mark.parametrize("text", ["", "nonsense", "3000000000\n"], ids=["empty", "nonsense", "set back"])
def test_after_a_failed_read_the_clock_counts_this_process(tmp_path: Path, text: str) -> None:
    """It goes on with the CPU time of this process alone, and never jumps back."""
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


def test_without_a_file_the_clock_counts_this_process(tmp_path: Path) -> None:
    """This holds if there is no file, and if it is gone before it is opened."""
    for clock in (Clock(None), Clock(tmp_path / "gone")):
        assert clock.used_s() == pytest.approx(time.process_time(), abs=TOLERANCE_S)


FORKED = """
import os, time
from offboard.common import cpu_time
real_time, real_file = time.process_time, cpu_time.usage_file

def fork():
    time.process_time, cpu_time.usage_file = real_time, real_file
    if os.fork() == 0:
        print("forked", cpu_time.used_s() >= 0, flush=True)
        os._exit(0)
    os.wait()

cpu_time.usage_file = lambda proc: fork()  # forks while the first call looks for the cgroup
cpu_time.used_s()
time.process_time = lambda: fork() or real_time()  # forks while the clock is read
cpu_time.used_s()
"""


def test_a_forked_process_looks_for_its_cgroup_anew() -> None:
    """A process that is forked while the clock is in use can use its own clock, and does not hang."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, cwd=ROOT, timeout=8)
    assert done.stdout == "forked True\n" * 2, done.stderr
