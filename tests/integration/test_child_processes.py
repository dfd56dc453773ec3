"""Commands that compute in several processes, and how these end."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from offboard.common.command_line import INTERRUPTED_EXIT
from tests.curves import until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]

JOBS = 2
COMMANDS = {
    "fleet": ["fleet", "--robots", "5000", "--out"],
    "compare": ["compare", "calm", "outage", "--simulate", "--seeds", "100", "--out"],
}
# CPU time of each process: it imports its modules, or it computes.
IMPORTING_S, COMPUTING_S = 0.05, 2.0


def children(command: int) -> list[Path]:
    """The folders in /proc of the processes that compute for a command."""
    found = Path(f"/proc/{command}/task/{command}/children").read_text().split()
    return [
        Path("/proc", one) for one in found if b"spawn_main" in Path("/proc", one, "cmdline").read_bytes()
    ]


def cpu_s(process: Path) -> float:
    used = (process / "stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, used)) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def busy(name: str, after_s: float, out: Path) -> "Iterator[subprocess.Popen[str]]":
    """A command whose processes have used this CPU time."""
    with subprocess.Popen(
        [sys.executable, "-m", "offboard.loadgen", *COMMANDS[name], str(out), "--jobs", str(JOBS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as command:
        try:
            until(lambda: sum(cpu_s(one) >= after_s for one in children(command.pid)) == JOBS)
            yield command
        finally:
            command.kill()


@pytest.mark.parametrize("after_s", [IMPORTING_S, COMPUTING_S])
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_ends_all_processes_with_one_line(name: str, after_s: float, tmp_path: Path) -> None:
    """The signal reaches all processes, as in a terminal; only the command itself says so."""
    with busy(name, after_s, tmp_path) as command:
        os.killpg(command.pid, signal.SIGINT)
        said = command.communicate(timeout=30)[1]
    assert command.returncode == INTERRUPTED_EXIT, said
    assert said == f"loadgen {name}: interrupted\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_no_process_outlives_a_killed_command(name: str, tmp_path: Path) -> None:
    """A command that is killed cannot end its processes, so they end by themselves."""
    with busy(name, COMPUTING_S, tmp_path) as command:
        computing = children(command.pid)
        command.kill()
        command.wait()
        until(lambda: not any(map(_runs, computing)))


ORPHAN = """
import multiprocessing, os, signal, time
from offboard.loadgen.simulation.child_processes import end_quietly

def child():
    print("child began", flush=True)
    while os.getppid() == multiprocessing.parent_process().pid:
        time.sleep(0.01)
    end_quietly()
    print("child goes on", flush=True)

if __name__ == "__main__":
    multiprocessing.get_context("spawn").Process(target=child).start()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_process_ends_if_its_command_was_killed_before_it_began(tmp_path: Path) -> None:
    """The kernel reports only a death that is still to come, so the process looks whether there was one."""
    (tmp_path / "orphan.py").write_text(ORPHAN)
    command = [sys.executable, str(tmp_path / "orphan.py")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (-signal.SIGKILL, "child began\n", "")


def _runs(process: Path) -> bool:
    with contextlib.suppress(OSError):
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False
