"""Keeps one worker process alive: gives it tasks, notices its death, and starts the next one.

`worker_pool` decides which worker gets a task; `worker_process` is what runs in the process.

    Worker (a thread)  --- [kind, frames, digests] --->  worker_process.work (a process)
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
from collections.abc import Callable
from typing import Any, NoReturn

import msgpack

from offboard.cloud_server.executors.executor import Call, Outcome
from offboard.cloud_server.executors.worker_process import (
    CHUNK_BYTES,
    STOPS,
    Setup,
    new_unpacker,
    outcome_of,
    packed,
)
from offboard.cloud_server.executors.worker_set import Assignment, Died
from offboard.common.errors import TaskFailed, describe
from offboard.common.task_call import always

START_S_MAX = 300.0  # until a worker is ready, compilation included
RESTART_PAUSE_S = 1.0  # at least, between two starts of one worker
FAILED_PAUSE_S = 5.0  # after a failed start, before the next one
LOOK_S = 0.02  # between two checks whether the answer is still wanted
OVERTIME_S = 1.0  # after its budget, until a task is killed
SEND_S_MAX = 10.0  # until a worker has received a task
LEAVE_S_MAX = 2.0  # until an idle process has ended by itself
END_S_MAX = 5.0  # until a process has ended that was killed or has closed its pipe
# Signals that others send: the kernel if memory is short, or an operator.
FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM)


class Worker:
    """A thread that owns one worker process, and starts the next one when that process dies.

    It calls `free` whenever the worker can take a task, and `died` after each death of the process.
    """

    def __init__(
        self, setup: Setup, free: Callable[["Worker"], None], died: Callable[["Worker", Died], None]
    ) -> None:
        self.pid = 0
        self._setup = setup
        self._free = free
        self._died = died
        self._assignment: Assignment | None = None
        self._began: float | None = None  # time at which the process got the call
        self._closing = threading.Event()
        self._wake = os.eventfd(0)
        # The process dies with the thread that started it (PDEATHSIG), so this thread never ends before it.
        self._thread = threading.Thread(target=self._keep, name="worker", daemon=True)
        self._thread.start()

    def give(self, assignment: Assignment) -> None:
        """Run this call. Called once after each `free`, and not after `died`."""
        self._assignment = assignment
        os.eventfd_write(self._wake, 1)

    def stop(self) -> None:
        """End the process and the thread. A running task is killed. `join` waits for both."""
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
            except Exception as error:  # noqa: BLE001 - no exception may end this worker for good
                fault = Died("server", f"was abandoned: {describe(error)}", server_fault=True)
                death = error if isinstance(error, Died) else fault
            self._died(self, death)
            self._answer(death)
            next_start = began + RESTART_PAUSE_S if up else time.monotonic() + FAILED_PAUSE_S
            self._closing.wait(max(0.0, next_start - time.monotonic()))

    def _start(self, process: "_Process") -> None:
        answer = self._next(process, START_S_MAX)
        if answer is None:
            raise Died("start", f"was not ready within {START_S_MAX:g} s")
        error, frames = answer
        if error:
            failure = TaskFailed(error, frames) if frames else None
            raise Died("start", f"did not start: {error}", failure=failure)

    def _serve(self, process: "_Process") -> NoReturn:
        self._free(self)
        while True:
            process.receive(None)
            if self._closing.is_set() and self._assignment is None:
                process.leave()
            self._check_open()
            if self._assignment is not None:
                self._run(process, self._assignment)

    def _run(self, process: "_Process", assignment: Assignment) -> None:
        process.send(assignment.call)
        self._began = time.monotonic()
        outcome = self._outcome(process, assignment.call)
        self._assignment = self._began = None
        self._free(self)  # before the answer, whose callback may bring the next task
        assignment.answer.set_result(outcome)

    def _outcome(self, process: "_Process", call: Call) -> Outcome:
        for limit_s in (call.budget_s, OVERTIME_S):
            answer = self._next(process, limit_s, call.wanted)
            if answer is not None:
                *fields, full = answer
                outcome = outcome_of(fields)
                if full:
                    raise Died("memory", "kept too much memory", outcome=outcome)
                return outcome
            process.stop_task()
        raise Died("budget", f"was killed {OVERTIME_S:g} s after the budget was over", server_fault=True)

    def _next(self, process: "_Process", limit_s: float, wanted: Callable[[], bool] = always) -> Any | None:
        """The next message of the process; None if it takes longer than `limit_s`."""
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
        """Answer the task that the dead process ran, or was about to run."""
        assignment, began = self._assignment, self._began
        self._assignment = self._began = None
        if assignment is None:
            return
        outcome = death.outcome
        if began is None:
            outcome = Outcome("busy", f"no worker can take the task: its worker {death}")
        elif outcome is None:
            error, run_s = f"the worker {death} while this task ran", time.monotonic() - began
            outcome = Outcome("failed", error, run_s, server_fault=death.server_fault, crashed=True)
        assignment.answer.set_result(outcome)


class _Process:
    """One worker process, which ends with the `with` block. A byte in shared memory asks its task to stop."""

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
        message = msgpack.packb(packed(call))
        try:
            self._pipe.sendall(message)
        except OSError as error:
            raise self._death() from error

    def stop_task(self) -> None:
        self._stop[0] = 1

    def receive(self, timeout_s: float | None) -> Any | None:
        """The next message; None after `timeout_s`, after a wake-up, and while the message is incomplete."""
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
        """Let the idle process end by itself."""
        self._pipe.shutdown(socket.SHUT_WR)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(LEAVE_S_MAX)

    def _death(self) -> Died:
        try:
            code = self._popen.wait(END_S_MAX)
        except subprocess.TimeoutExpired:
            return Died("exit", "closed its pipe, or does not read from it")
        if code >= 0:
            return Died("exit", f"left with exit code {code}")
        name = next((one.name for one in signal.Signals if one == -code), str(-code))
        return Died("signal", f"was killed by signal {name}", server_fault=-code in FROM_OUTSIDE)

    def _end(self) -> None:
        self._popen.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._popen.wait(END_S_MAX)


def _spawn(pipe: int, flag: int, setup: Setup) -> "subprocess.Popen[bytes]":
    """Start a worker process. `multiprocessing` cannot: threads that start processes reap each other's."""
    path = [str(folder) for folder in sys.path]
    home = "offboard.cloud_server.executors.worker_process"
    code = f"import sys; sys.path[:] = {path}; from {home} import Setup, work; "
    code += f"work({os.getpid()}, {pipe}, {flag}, {setup!r})"
    command = [sys.executable, "-u", "-c", code]  # -u: a crash does not lose what the task has printed
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)  # until the process has its own handlers
    try:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(pipe, flag))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
