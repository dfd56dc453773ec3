"""One process of the local testbed: starts it so that it cannot outlive us, waits until it is ready, ends it.

`local_testbed` decides which processes there are.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

from offboard.common.errors import OffloadError
from offboard.loadgen.progress import drawn_on
from offboard.loadgen.relay.relay_client import ask
from offboard.loadgen.testbed.cpu_quota import Quota
from offboard.loadgen.testbed.real_testbed import (
    KILL_S,
    TAIL_BYTES,
    TERMINATE_S,
    Output,
    last_lines,
    poll_until_ready,
)
from offboard.loadgen.testbed.testbed import PART

LAUNCH_S = 10.0
CHUNK_BYTES = 1 << 16

# A Python program that becomes the command argv[3:]. The kernel kills it when the testbed (process argv[1])
# dies, even if it is stopped. The pipe argv[2] closes when it becomes the command. The parent is checked
# after prctl, because prctl has no effect if the parent died before.
LAUNCHER = """
import ctypes, os, signal, sys
PR_SET_PDEATHSIG = 1
if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
    sys.exit("prctl: " + os.strerror(ctypes.get_errno()))
if os.getppid() != int(sys.argv[1]):
    sys.exit("the testbed is gone")
os.set_inheritable(int(sys.argv[2]), False)
try:
    os.execvp(sys.argv[3], sys.argv[3:])
except OSError as error:
    sys.exit(f"cannot run {sys.argv[3]}: {error.strerror}")
"""


@dataclass(frozen=True, slots=True)
class Part:
    """One process of a testbed.

    `http` (HOST:PORT) answers 200 at the path `ready` once the process is ready; None: there is nothing to
    wait for.
    `cpus` is its CPU quota; None: no quota.
    Its output goes to logs/NAME.log, or to our own output if it is `shown`. On a terminal it goes through
    this process, which may draw a bar there.
    """

    name: str
    command: tuple[str, ...]
    http: str | None = None
    ready: str = "/ready"
    cpus: float | None = None
    shown: bool = False


@dataclass(slots=True)
class Child:
    """A part that was started."""

    part: Part
    process: subprocess.Popen[bytes]
    log: Path
    log_start: int  # size of the log before this start
    launched: int  # pipe that reaches its end once the launcher has become the part
    quota: Quota | None = None
    output: Output | None = None

    def wait_launched(self) -> None:
        """Wait until the process can no longer outlive us; from then on it may be stopped."""
        try:
            if not select.select([self.launched], [], [], LAUNCH_S)[0]:
                raise OffloadError(f"{self.part.name} could not be launched within {LAUNCH_S:g} s")
        finally:
            os.close(self.launched)

    def let_go(self) -> None:
        """Release the process from its quota and continue it."""
        if self.quota is not None:
            self.quota.close()
            self.quota = None
        self.send(signal.SIGCONT)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process and to its workers, which are in its process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def kill(self) -> None:
        """End the process and its workers by SIGKILL."""
        self.send(signal.SIGKILL)
        self.process.wait(KILL_S)

    def finish_output(self) -> None:
        """Wait for the last output of a process that has ended, if it goes through us."""
        if self.output is not None:
            self.output.finish()
            self.output = None
            assert self.process.stdout is not None
            self.process.stdout.close()

    def tail(self) -> str:
        with self.log.open("rb") as file:
            file.seek(max(self.log_start, self.log.stat().st_size - TAIL_BYTES))
            return last_lines(file.read())


def launch(part: Part, log: Path, *, again: bool) -> Child:
    """Start the part. From the start on, it dies with this thread.

    `again` appends to its log instead of replacing it.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab" if again else "wb") as file:
        launched, launching = os.pipe()
        launcher = [sys.executable, "-I", "-S", "-c", LAUNCHER, str(os.getpid()), str(launching)]
        through_us = part.shown and drawn_on(sys.stdout)
        output: Any = {"stdout": subprocess.PIPE if through_us else file, "stderr": subprocess.STDOUT}
        process = subprocess.Popen(
            [*launcher, *part.command],
            stdin=subprocess.DEVNULL,
            env={**os.environ, PART: part.name},
            start_new_session=True,
            pass_fds=[launching],
            **({} if part.shown and not through_us else output),
        )
        os.close(launching)
        child = Child(part, process, log, log_start=file.tell(), launched=launched)
    if process.stdout is not None:
        chunks = iter(partial(os.read, process.stdout.fileno(), CHUNK_BYTES), b"")
        child.output = Output(part.name, chunks, None)
        child.output.start()
    return child


def wait_ready(child: Child, timeout_s: float) -> None:
    """Wait until the part answers 200; otherwise the error contains the end of its log."""
    part = child.part
    http = part.http
    assert http is not None

    def ready() -> bool:
        return ask(http, "GET", part.ready)[0] == HTTPStatus.OK

    poll_until_ready(
        part.name, ready, child.process.poll, tail=child.tail, log=child.log, timeout_s=timeout_s
    )


def end(child: Child) -> None:
    """Release the part from its quota, ask it to end, then kill it and the workers that are left."""
    child.let_go()
    if child.process.poll() is None:
        child.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(TERMINATE_S)
    child.kill()
