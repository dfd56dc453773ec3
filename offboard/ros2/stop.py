"""Stops calls of an offloader: a stopped call ends within milliseconds, and its runs are cancelled.

Which call is stopped is decided in `planner_server`.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from offboard.common.errors import Unwanted
from offboard.common.tasks import Kind, Task
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.servers import connect_sites
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.clock import SystemClock
from offboard.robot_client.sites.runner import Condition, Execution, Runner, Sending


class Stop:
    """Ends the calls that a thread makes `within` it: they raise Unwanted. Any thread may call `stop`."""

    def __init__(self) -> None:
        self._stopped: Future[None] = Future()
        self._lock = threading.Lock()
        self._runs: list[tuple[Runner, Task]] = []

    def stop(self) -> None:
        """End the call. Safe to call twice, and before the call begins."""
        with self._lock:
            if not self._stopped.done():
                self._stopped.set_result(None)

    @property
    def stopped(self) -> bool:
        return self._stopped.done()

    @contextmanager
    def within(self) -> Iterator[None]:
        """Calls that this thread makes in here can be stopped."""
        _here.stop = self
        try:
            yield
        finally:
            _here.stop = None

    def note(self, runner: Runner, task: Task) -> None:
        self._runs.append((runner, task))

    def wait(
        self, wait: Callable[..., None], pending: Sequence["Future[Any]"], timeout_s: float | None
    ) -> None:
        """Wait as the clock does; when stopped, cancel the runs and raise Unwanted."""
        wait([*pending, self._stopped], timeout_s)
        if self.stopped:
            for runner, task in self._runs:
                runner.cancel(task)
            raise Unwanted("the goal was stopped")


class _Here(threading.local):
    stop: Stop | None = None


_here = _Here()


class StoppableClock(SystemClock):
    """Waits for runs, or for the stop of the call that waits."""

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        if _here.stop is None:
            super().wait(pending, timeout_s)
        else:
            _here.stop.wait(super().wait, pending, timeout_s)


class StoppableRunner:
    """A runner whose runs are noted, so that a stop cancels them."""

    def __init__(self, inner: Runner) -> None:
        self._inner = inner
        self.site = inner.site
        self.unavailable: Callable[[Kind], str | None] = inner.unavailable
        self.to_send: Callable[[Task], Sending] = inner.to_send
        self.cancel: Callable[[Task], None] = inner.cancel
        self.hurry: Callable[[], None] = inner.hurry
        self.condition: Callable[[], Condition] = inner.condition
        self.close: Callable[[], None] = inner.close

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        if _here.stop is not None:
            _here.stop.note(self._inner, task)
        return self._inner.submit(task, budget_s)


def connect(
    endpoint: str | None,
    *,
    sites: Path | None = None,
    policy: str,
    timeout_s: float,
    keys: Path | None,
    settings: Settings,
    observers: Sequence[Callable[[Record], None]],
) -> Offloader:
    """An offloader as `Offloader.connect` makes it, whose calls can be stopped."""
    chosen, memories = settings.make_policy(policy), settings.make_memories(policy)
    present = connect_sites(
        endpoint, sites or {}, keys=keys, policy=policy, settings=settings, wrap=StoppableRunner
    )
    return Offloader(
        present,
        policy=chosen,
        memories=memories,
        allowance=settings.allowance(),
        timeout_s=timeout_s,
        observers=observers,
        clock=StoppableClock(),
    )
