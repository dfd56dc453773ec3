"""Quotas on real processes: a cgroup where this machine lets us make one, stop-continue anywhere."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from common.errors import ConfigError
from loadgen.quota import CgroupQuota, Quota, SignalQuota, hold

BUSY = "while True: pass"
BUSY_THREADS = """
import hashlib, threading
def work():
    while True: hashlib.sha256(bytes(1 << 20))
for _ in range(2): threading.Thread(target=work).start()
"""
EXITING_HOLDER = (
    "import time; from loadgen.quota import SignalQuota; SignalQuota({}, 0.05); time.sleep(0.2); 1 / 0"
)
KILLED_HOLDER = (
    "import time; from loadgen.quota import hold; print(hold({}, 0.5)._group, flush=True); time.sleep(9)"
)
SHARE = 0.25
TOLERANCE = 0.15
MEASURE_S = 1.5
HELD: dict[str, Callable[[int, float], Quota]] = {"cgroup": hold, "stop-continue": SignalQuota}


@pytest.fixture
def child() -> Iterator[Callable[[str], int]]:
    """Factory: a Python process that runs the given code; returns its pid."""
    with contextlib.ExitStack() as stack:

        def start(code: str = BUSY) -> int:
            process = stack.enter_context(subprocess.Popen([sys.executable, "-S", "-c", code]))
            stack.callback(process.kill)
            return process.pid

        yield start


@pytest.fixture(params=HELD)
def held(request: pytest.FixtureRequest) -> Callable[[int, float], Quota]:
    """Each way to hold a process; the cgroup is skipped where none may be made."""

    def start(pid: int, cpus: float) -> Quota:
        quota = HELD[request.param](pid, cpus)
        if request.param == "cgroup" and not isinstance(quota, CgroupQuota):
            quota.close()
            pytest.skip("no cgroup with a CPU controller may be made here")
        return quota

    return start


def used_share(pid: int) -> float:
    """CPU time over wall time of a process, from now on."""
    clock = (~pid << 3) | 2
    wall_s, cpu_s = time.monotonic(), time.clock_gettime(clock)
    time.sleep(MEASURE_S)
    return (time.clock_gettime(clock) - cpu_s) / (time.monotonic() - wall_s)


def state(pid: int) -> str:
    """R, S, T (stopped), ... as the kernel says it."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.parametrize("code", [BUSY, BUSY_THREADS], ids=["one thread", "two threads"])
def test_a_busy_process_gets_its_share(
    child: Callable[[str], int], held: Callable[..., Quota], code: str
) -> None:
    """Held to 0.25 CPU a busy process gets that much, +-15 %, all its threads together."""
    pid = child(code)
    with held(pid, SHARE) as quota:
        share = used_share(pid)
        print(f"{quota.kind}: {share:.4f} CPU")
        assert quota.cpus == SHARE
        assert share == pytest.approx(SHARE, rel=TOLERANCE)


def test_a_quota_can_be_changed(child: Callable[[str], int], held: Callable[..., Quota]) -> None:
    """A process held to little gets its larger share once the quota is set to it."""
    pid = child(BUSY)
    with held(pid, 0.05) as quota:
        time.sleep(0.2)
        quota.set(SHARE)
        assert quota.cpus == pytest.approx(SHARE)
        assert used_share(pid) == pytest.approx(SHARE, rel=TOLERANCE)


def test_another_process_shares_the_quota(child: Callable[[str], int], held: Callable[..., Quota]) -> None:
    """A hog beside the process: both together get the share, and each about half of it."""
    pid, hog = child(BUSY), child(BUSY)
    with held(pid, SHARE) as quota:
        quota.add(hog)
        time.sleep(0.2)
        with ThreadPoolExecutor(2) as threads:
            mine, theirs = threads.map(used_share, (pid, hog))
        assert mine + theirs == pytest.approx(SHARE, rel=TOLERANCE)
        assert mine == pytest.approx(SHARE / 2, rel=0.4)


def test_a_closed_quota_lets_the_process_run(child: Callable[[str], int], held: Callable[..., Quota]) -> None:
    """After close the process is not stopped, its group is gone, and close may be called again."""
    pid = child(BUSY)
    before = Path(f"/proc/{pid}/cgroup").read_text()
    quota = held(pid, 0.05)
    time.sleep(0.1)
    quota.close()
    quota.close()
    assert {state(pid) for _ in range(100)} == {"R"}
    assert Path(f"/proc/{pid}/cgroup").read_text() == before


def test_a_pause_lasts_until_resume(child: Callable[[str], int], held: Callable[..., Quota]) -> None:
    """A paused process stays stopped through many periods; resumed it runs, still held."""
    pid = child(BUSY)
    with held(pid, 0.5) as quota:
        quota.pause()
        clock = (~pid << 3) | 2
        time.sleep(0.01)
        before_s = time.clock_gettime(clock)
        time.sleep(0.2)
        assert time.clock_gettime(clock) == before_s
        quota.resume()
        time.sleep(0.2)
        assert time.clock_gettime(clock) - before_s == pytest.approx(0.1, abs=0.05)


def test_a_process_that_ends_is_no_error(held: Callable[..., Quota]) -> None:
    """A held process may be killed and waited for at any time; close is silent then."""
    process = subprocess.Popen([sys.executable, "-S", "-c", BUSY])
    try:
        quota = held(process.pid, SHARE)
    finally:
        process.kill()
        process.wait()
    quota.pause()
    quota.resume()
    quota.close()


def test_an_idle_process_saves_up_no_share(child: Callable[[str], int]) -> None:
    """Stop-continue: after a second of sleep a process gets its share, not the second's as well."""
    pid = child(f"import time; time.sleep(0.5)\n{BUSY}")
    with SignalQuota(pid, SHARE):
        time.sleep(0.7)
        assert used_share(pid) == pytest.approx(SHARE, rel=TOLERANCE)


def test_a_holder_that_exits_continues_the_process(child: Callable[[str], int]) -> None:
    """A holder that ends without close, by an exception say, leaves no stopped process behind."""
    pid = child(BUSY)
    command = [sys.executable, "-c", EXITING_HOLDER.format(pid)]
    done = subprocess.run(command, capture_output=True, check=False)
    assert b"ZeroDivisionError" in done.stderr
    assert {state(pid) for _ in range(100)} == {"R"}


def test_a_group_left_by_a_killed_holder_is_removed(child: Callable[[str], int]) -> None:
    """The next quota removes the empty group of a holder that was killed with -9."""
    pid = child(BUSY)
    command = [sys.executable, "-c", KILLED_HOLDER.format(pid)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        left = process.stdout.readline().decode().strip()
        process.kill()
    if not left:
        pytest.skip("no cgroup with a CPU controller may be made here")
    assert Path(left).is_dir()
    Path(left).parent.joinpath("cgroup.procs").write_text(str(pid))
    hold(pid, SHARE).close()
    assert not Path(left).exists()


@pytest.mark.parametrize("cpus", [0, -1, 0.01, 1000, float("nan")])
def test_a_share_that_cannot_be_is_named(cpus: float) -> None:
    """A share outside its bounds is refused, with the bounds."""
    with pytest.raises(ConfigError, match=r"CPU quota .* is not a number from 0\.05 to 64"):
        hold(os.getpid(), cpus)


def test_killing_a_stopped_process_works() -> None:
    """SIGKILL ends a process that the quota has stopped."""
    process = subprocess.Popen([sys.executable, "-S", "-c", BUSY])
    with SignalQuota(process.pid, 0.05) as quota:
        quota.pause()
        process.kill()
        assert process.wait(5) == -signal.SIGKILL
