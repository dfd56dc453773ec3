"""The load on real CPUs, of a process that may use one of them."""

import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from offboard.common.cpu_time import SELF, quota_group

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two CPUs"),
    pytest.mark.skipif(quota_group(SELF) is not None, reason="under a quota, the load is a share of it"),
]

ROOT = Path(__file__).parents[2]
READINGS = 6
TOLERANCE = 0.15
HOG = "while True: pass"

# Stays on one CPU. For each reading it prints the load, the capacity, and the busy share of that CPU.
WATCHED = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
from offboard.common.cpu_time import SELF
from offboard.common.load import EVERY_S, Load

def idle_s():
    with open("/proc/stat") as file:
        fields = next(line.split() for line in file if line.startswith(f"cpu{sys.argv[1]} "))
    return (int(fields[4]) + int(fields[5])) / os.sysconf("SC_CLK_TCK")

load = Load(SELF)
load.share()
before_s, idle_before_s = time.monotonic(), idle_s()
for _ in range(int(sys.argv[2])):
    time.sleep(EVERY_S)
    share, now_s, idle_now_s = load.share(), time.monotonic(), idle_s()
    print(share, load.capacity, 1 - (idle_now_s - idle_before_s) / (now_s - before_s), flush=True)
    before_s, idle_before_s = now_s, idle_now_s
"""


def loads(own: int, busy: int) -> tuple[float, float]:
    """The median load that a process on the CPU `own` reads, and the median busy share of that CPU.

    Meanwhile another program computes on the CPU `busy`.
    """
    with subprocess.Popen([sys.executable, "-S", "-c", HOG]) as hog:
        try:
            os.sched_setaffinity(hog.pid, {busy})
            text = subprocess.check_output(
                [sys.executable, "-c", WATCHED, str(own), str(READINGS)], text=True, cwd=ROOT, timeout=30
            )
        finally:
            hog.kill()
    load, capacity, share = zip(*(map(float, line.split()) for line in text.splitlines()), strict=True)
    assert all(0 < one <= 1 for one in capacity)
    return statistics.median(load), statistics.median(share)


def test_a_program_on_another_cpu_is_no_load() -> None:
    """The load is the busy share of the CPU that the process may use: near 0 if no other test runs there."""
    own, other, *_ = sorted(os.sched_getaffinity(0))
    load, share = loads(own, busy=other)
    assert load == pytest.approx(share, abs=TOLERANCE)


def test_a_program_on_the_same_cpu_is_load() -> None:
    """It takes all that the process leaves."""
    own, *_ = sorted(os.sched_getaffinity(0))
    load, share = loads(own, busy=own)
    assert load == pytest.approx(1.0, abs=TOLERANCE), f"busy share {share:.2f}"
