"""The threads that keep a worker process each: hand it tasks, tell how it died, and start the next one.

What a worker process does is `inside`; which worker gets a task is decided in `executors`.

    Worker (a thread)  --- [kind, frames, digests] --->  inside.work (a process)
                       <-- [status, ..., frames, full] -
"""

import contextlib
import math
import mmap
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import astuple, dataclass, field
from typing import Any, NoReturn

import msgpack

from offboard.cloud_server.outcome import Outcome
from offboard.cloud_server.worker_process import CHUNK_BYTES, new_unpacker
from offboard.common.errors import describe
from offboard.common.wanted import always
from offboard.common.wire.blobs import Buffer

START_S_MAX = 300.0  # the slowest worker's start, compilation included
RESTART_PAUSE_S = 1.0  # least time between two starts of one worker
FAILED_PAUSE_S = 5.0  # before the next start, after one that failed
LOOK_S = 0.02  # between two looks whether an answer is still wanted
OVERTIME_S = 1.0  # for a task to end once its budget is over
SEND_S_MAX = 10.0  # for a worker to take a task
LEAVE_S_MAX = 2.0  # for an idle process to end by itself
END_S_MAX = 5.0  # for a process to be gone that was killed, or closed its pipe
# Signals of others: of the kernel where the machine's memory is short, of an operator.
FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM)


@dataclass(frozen=True, slots=True)
class Setup:
    """What a worker process is told at its start."""

    modules: tuple[str, ...]
    folder: str  # where blobs are files
    blob_bytes_max: int
    memory_bytes_max: int


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """One task for a worker; its answer never holds an exception."""

    kind: str
    frames: Sequence[Buffer]
    digests: Sequence[bytes]
    wanted: Callable[[], bool]
    budget_s: float
    answer: "Future[Outcome]" = field(default_factory=Future)


class Died(Exception):
    """A worker process ended, or has to; `reason` is one word, `outcome` what its task had come to before."""

    def __init__(
        self, reason: str, text: str, *, server_fault: bool = False, outcome: Outcome | None = None
    ) -> None:
        super().__init__(text)
        self.reason = reason
        self.server_fault = server_fault
        self.outcome = outcome


class Worker:
    """A thread that owns one process: hands it tasks one by one, and starts another one when it died.

    In this thread `free` is called when it can take a task, and `died` when its process is no more.
    """

    def __init__(
        self, setup: Setup, free: Callable[["Worker"], None], died: Callable[["Worker", Died], None]
    ) -> None:
        self.pid = 0
        self._setup = setup
        self._free = free
        self._died = died
        self._call: Call | None = None
        self._began: float | None = None  # when the process had been handed the call
        self._closing = threading.Event()
        self._wake = os.eventfd(0)
        # The process dies with the thread that starts it (PDEATHSIG): this one lives as long as the slot.
        self._thread = threading.Thread(target=self._keep, name="worker", daemon=True)
        self._thread.start()

    def give(self, call: Call) -> None:
        """Once after each `free`, and not after `died`."""
        self._call = call
        os.eventfd_write(self._wake, 1)

    def stop(self) -> None:
        """End the process, by force where a task runs, and the thread; `join` waits for both."""
        self._closing.set()
        os.eventfd_write(self._wake, 1)

    def join(self) -> None:
        self._thread.join(SEND_S_MAX + END_S_MAX)
        if not self._thread.is_alive():
            os.close(self._wake)

    def _keep(self) -> None:
        while not self._closing.is_set():
            began, up = time.monotonic(), False
            try:
                with _Process(self._setup, self._wake) as process:
                    self.pid = process.pid
                    self._start(process)
                    up = True
                    self._serve(process)
            except Exception as error:  # noqa: BLE001 - a slot is not lost, whatever happened
                fault = Died("server", f"was given up: {describe(error)}", server_fault=True)
                death = error if isinstance(error, Died) else fault
            self._died(self, death)
            self._answer(death)
            next_start = began + RESTART_PAUSE_S if up else time.monotonic() + FAILED_PAUSE_S
            self._closing.wait(max(0.0, next_start - time.monotonic()))

    def _start(self, process: "_Process") -> None:
        error = self._next(process, START_S_MAX)
        if error is None:
            raise Died("start", f"was not ready within {START_S_MAX:g} s")
        if error:
            raise Died("start", f"did not start: {error}")

    def _serve(self, process: "_Process") -> NoReturn:
        self._free(self)
        while True:
            process.receive(None)
            if self._closing.is_set() and self._call is None:
                process.leave()
            self._check_open()
            if self._call is not None:
                self._run(process, self._call)

    def _run(self, process: "_Process", call: Call) -> None:
        process.send(call)
        self._began = time.monotonic()
        outcome = self._outcome(process, call)
        self._call = self._began = None
        self._free(self)  # first: whoever hears of the answer may bring the next task
        call.answer.set_result(outcome)

    def _outcome(self, process: "_Process", call: Call) -> Outcome:
        for limit_s in (call.budget_s, OVERTIME_S):
            answer = self._next(process, limit_s, call.wanted)
            if answer is not None:
                *fields, full = answer
                outcome = Outcome(*fields)
                if full:
                    raise Died("memory", "kept too much memory", outcome=outcome)
                return outcome
            process.stop_task()
        raise Died("budget", f"was killed {OVERTIME_S:g} s after the budget was over", server_fault=True)

    def _next(self, process: "_Process", limit_s: float, wanted: Callable[[], bool] = always) -> Any | None:
        """The next message of the process; None where it takes longer."""
        until = time.monotonic() + limit_s
        while (left_s := until - time.monotonic()) > 0:
            message = process.receive(min(left_s, LOOK_S))
            self._check_open()
            if message is not None:
                return message
            if not wanted():
                process.stop_task()
        return None

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise Died("closed", "was ended with the server", server_fault=True)

    def _answer(self, death: Died) -> None:
        """For the task that the dead process had, or was to get."""
        call, began = self._call, self._began
        self._call = self._began = None
        if call is None:
            return
        outcome = death.outcome
        if began is None:
            outcome = Outcome("busy", f"no worker can take it: the one that was to {death}")
        elif outcome is None:
            error, run_s = f"the worker {death} while this task ran", time.monotonic() - began
            outcome = Outcome("failed", error, run_s, server_fault=death.server_fault, crashed=True)
        call.answer.set_result(outcome)


class _Process:
    """One worker process, until the `with` is left; a byte in shared memory asks its task to stop."""

    def __init__(self, setup: Setup, wake: int) -> None:
        self._wake = wake
        with contextlib.ExitStack() as stack:
            self._pipe, theirs = socket.socketpair()
            stack.enter_context(self._pipe).settimeout(SEND_S_MAX)
            flag = os.memfd_create("stop")
            with theirs, os.fdopen(flag, "wb"):
                os.ftruncate(flag, 1)
                self._stop = stack.enter_context(mmap.mmap(flag, 1))
                self._popen = _spawn(theirs.fileno(), flag, setup)
            stack.callback(self._end)
            self.pid = self._popen.pid
            self._exit = os.pidfd_open(self.pid)
            stack.callback(os.close, self._exit)
            self._close = stack.pop_all().close
        self._unpacker = new_unpacker()
        self._poller = select.poll()
        for fd in (self._pipe.fileno(), self._exit, wake):
            self._poller.register(fd, select.POLLIN)

    def __enter__(self) -> "_Process":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def send(self, call: Call) -> None:
        self._stop[0] = 0
        self._unpacker = new_unpacker()  # the last one may have grown with its message
        message = msgpack.packb([call.kind, list(call.frames), list(call.digests)])
        try:
            self._pipe.sendall(message)
        except OSError as error:
            raise self._death() from error

    def stop_task(self) -> None:
        self._stop[0] = 1

    def receive(self, timeout_s: float | None) -> Any | None:
        """The next message; None after `timeout_s`, when woken, and while only part of it is here."""
        ready = {fd for fd, _ in self._poller.poll(None if timeout_s is None else math.ceil(timeout_s * 1e3))}
        if self._wake in ready:
            os.eventfd_read(self._wake)
        if self._pipe.fileno() in ready:
            with contextlib.suppress(ConnectionResetError):
                if data := self._pipe.recv(CHUNK_BYTES):
                    self._unpacker.feed(data)
                    return next(self._unpacker, None)
            raise self._death()
        if self._exit in ready:
            raise self._death()
        return None

    def leave(self) -> None:
        """Let it end by itself, as it has no task."""
        self._pipe.shutdown(socket.SHUT_WR)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(LEAVE_S_MAX)

    def _death(self) -> Died:
        try:
            code = self._popen.wait(END_S_MAX)
        except subprocess.TimeoutExpired:
            return Died("exit", "closed its pipe, or does not read it")
        if code >= 0:
            return Died("exit", f"left with exit code {code}")
        name = next((one.name for one in signal.Signals if one == -code), str(-code))
        return Died("signal", f"was killed by signal {name}", server_fault=-code in FROM_OUTSIDE)

    def _end(self) -> None:
        self._popen.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(END_S_MAX)


def _spawn(pipe: int, flag: int, setup: Setup) -> "subprocess.Popen[bytes]":
    """Not `multiprocessing`, in which threads that start processes reap each other's."""
    path = [str(folder) for folder in sys.path]
    code = f"import sys; sys.path[:] = {path}; from offboard.cloud_server.worker_process import work; "
    code += f"work{(os.getpid(), pipe, flag, *astuple(setup))}"
    command = [sys.executable, "-u", "-c", code]  # -u: what a task printed is not lost in a crash
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(pipe, flag))
