"""Cancelled calls: nothing is left of them on the robot or the server, and their records are right."""

import asyncio
import contextlib
import os
import random
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, wait
from pathlib import Path
from typing import Any

import pytest

from offboard import Offloader, Record
from offboard.robot_client.execution.call_future import CallFuture
from tests.integration.server.peers import WAIT_S, Running, until

CALLS = 1000 if os.environ.get("CHAOS") else 40
AT_ONCE = 8
SEED = 11
AGAIN_S = 10.0


class Bench:
    """A server with one worker in this process, and a robot that is connected to it."""

    def __init__(self, running: Running) -> None:
        import served_tasks

        self.tasks: Any = served_tasks
        self.server = running
        self.records: list[Record] = []
        self.offload = Offloader.connect(running.server.endpoint, observers=[self.records.append])
        assert self.offload.wait_for_sites(self.tasks.served_look, WAIT_S) == {}

    def submit(self, path: Path) -> CallFuture[None]:
        """A call that runs on the server until the file has a text."""
        return self.offload.submit(self.tasks.served_look, str(path), where="cloud", timeout_s=60.0)

    def waiting(self) -> float:
        return self.server.counted("waiting_requests")

    def nothing_is_left(self) -> bool:
        counted = [self.waiting(), self.server.counted("running_tasks")]
        return not any(counted) and not any(one.in_flight for one in self.offload.sites.values())


@pytest.fixture
def bench(serve: Callable[..., Running]) -> Iterator[Bench]:
    made = Bench(serve("threads", queue_max=2 * AT_ONCE))
    yield made
    until(made.nothing_is_left)
    made.offload.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "onboard"]


@contextlib.contextmanager
def ctrl_c(after_s: float) -> Iterator[None]:
    """Interrupt the main thread after this time, and again every AGAIN_S until the block has ended.

    Python drops an interrupt that comes while a destructor or the callback of a weak reference runs there,
    such as that of an object of an earlier test. A user would press Ctrl-C again.
    """
    ended, main = threading.Event(), threading.main_thread().ident
    assert main is not None

    def press() -> None:
        pause_s = after_s
        while not ended.wait(pause_s):
            signal.pthread_kill(main, signal.SIGINT)
            pause_s = AGAIN_S

    presser = threading.Thread(target=press)
    presser.start()
    try:
        yield
    finally:
        ended.set()
        presser.join()


def check_cancelled(call: CallFuture[Any], begun: tuple[str, ...]) -> None:
    """The caller gets CancelledError at once, and the record has the runs that had begun."""
    assert call.cancelled()
    assert not call.running()
    with pytest.raises(CancelledError):
        call.result()
    record = call.record
    assert record is not None
    assert (record.cancelled, record.used) == (True, None)
    assert tuple(one.site for one in record.executions) == begun
    assert record.happened.startswith("cancelled after ")


def test_calls_are_cancelled_while_they_wait_at_the_server(bench: Bench, tmp_path: Path) -> None:
    """Their requests leave the queue of the server, and none of them runs."""
    blocker, path = tmp_path / "blocker", tmp_path / "path"
    blocker.touch()
    path.touch()
    first = bench.submit(blocker)
    until(lambda: bool(bench.server.counted("running_tasks")))
    for _ in range(CALLS // AT_ONCE):
        calls = [bench.submit(path) for _ in range(AT_ONCE)]
        until(lambda: bench.waiting() == AT_ONCE)
        assert all(call.cancel() for call in calls)
        for call in calls:
            check_cancelled(call, ("cloud",))
        until(lambda: bench.waiting() == 0)
    assert not path.with_name("path.begun").exists()
    blocker.write_text("end")
    assert first.result(WAIT_S) is None
    assert len(bench.records) == CALLS // AT_ONCE * AT_ONCE + 1


def test_calls_are_cancelled_while_they_run(bench: Bench, tmp_path: Path) -> None:
    """The function on the server stops where it calls `check_wanted`."""
    path, stopped = tmp_path / "path", tmp_path / "path.stopped"
    path.touch()
    for number in range(1, CALLS + 1):
        call = bench.submit(path)
        until(lambda: bool(bench.server.counted("running_tasks")))
        assert call.cancel()
        assert call.cancel()  # once more changes nothing
        check_cancelled(call, ("cloud",))
        until(bench.nothing_is_left)
        begun = path.with_name("path.begun")
        assert begun.read_text().count("begun") == stopped.read_text().count("stopped") == number


def test_calls_are_cancelled_while_their_answer_is_on_its_way(bench: Bench) -> None:
    """A call that is cancelled at any moment has a result, or was cancelled; its record says which."""
    pause, ended = random.Random(SEED), {True: 0, False: 0}
    for _ in range(CALLS):
        call = bench.offload.submit(bench.tasks.served_count)
        pause_s = pause.uniform(0.0, 2e-3)
        wait([call], pause_s)
        cancelled = call.cancel()
        ended[cancelled] += 1
        assert call.done()
        record = call.record
        if record is None:
            assert cancelled  # before its thread began
        else:
            assert record.cancelled or record.used in ("onboard", "cloud")
        if not cancelled:
            assert isinstance(call.result(), int)
            assert record is not None
            assert not record.cancelled
    assert all(ended.values()), ended


def test_a_batch_that_is_left_by_ctrl_c_is_cancelled(bench: Bench, tmp_path: Path) -> None:
    """No task of it goes on, on either site, and none is begun later."""
    path = tmp_path / "path"
    path.touch()
    for _ in range(max(2, CALLS // AT_ONCE)):
        with ctrl_c(0.03), pytest.raises(KeyboardInterrupt):
            bench.offload.map(bench.tasks.served_look, [str(path)] * AT_ONCE, timeout_s=60.0)
        until(bench.nothing_is_left)
    begun, stopped = (path.with_name(f"path.{name}") for name in ("begun", "stopped"))
    until(lambda: begun.read_text().count("begun") == stopped.read_text().count("stopped"))
    assert not path.with_name("path.ended").exists()
    assert bench.records
    assert all(record.cancelled for record in bench.records)


def test_calls_are_cancelled_by_asyncio(bench: Bench, tmp_path: Path) -> None:
    """The cancel of an asyncio task reaches the runs of its call."""
    path = tmp_path / "path"
    path.touch()

    async def cancel_some() -> None:
        calls = [
            asyncio.create_task(bench.offload.run(bench.tasks.served_look, str(path), timeout_s=60.0))
            for _ in range(AT_ONCE)
        ]
        await asyncio.sleep(0.005)
        for call in calls:
            call.cancel()
        ended = await asyncio.gather(*calls, return_exceptions=True)
        assert all(isinstance(one, asyncio.CancelledError) for one in ended)

    for _ in range(CALLS // AT_ONCE):
        asyncio.run(cancel_some())
        until(bench.nothing_is_left)
    assert not path.with_name("path.ended").exists()
    assert all(record.cancelled for record in bench.records)


def test_a_cancelled_call_with_a_deadline_ends(bench: Bench, tmp_path: Path) -> None:
    """It ends before its deadline, in the thread that waits for the answer too."""
    path = tmp_path / "path"
    path.touch()
    call = bench.offload.submit(bench.tasks.served_look, str(path), deadline_s=30.0)
    until(lambda: bool(bench.server.counted("running_tasks")) or path.with_name("path.begun").exists())
    assert call.cancel()
    record = call.record
    assert record is not None
    assert record.cancelled
    until(bench.nothing_is_left)
