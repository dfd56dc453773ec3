"""Which thread reads and which runs a task, with real threads and without a socket."""

import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue

import pytest

from offboard.cloud_server import reader_threads
from offboard.cloud_server.executors.executor import Call, Outcome
from offboard.cloud_server.executors.thread_executor import ThreadExecutor
from offboard.cloud_server.fair_queue import Work
from offboard.cloud_server.reader_threads import ReaderThreads
from offboard.common.tasks import task
from offboard.common.wire.messages import Request, encode

WAIT_S = 5.0
AWAY_S = 0.1  # long enough for a busy computer to begin a task
go = threading.Event()


@task("read_short", size=lambda _: 1.0)
def read_short(what: str) -> None:
    """Return at once, wait for another task, or be that other task."""
    if what == "wait":
        assert go.wait(WAIT_S)
    elif what == "go":
        go.set()


class Watched(ThreadExecutor):
    """Notes for each task that the reading thread runs whether another thread wakes to read."""

    def __init__(self) -> None:
        super().__init__(2)
        self.hand_overs: list[bool] = []

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:
        self.hand_overs.append(meanwhile is not None)
        return super().run(call, meanwhile=meanwhile)


class Reading:
    """Reader threads that read what `bring` brings. `outcome` waits for the outcome of a task."""

    def __init__(self) -> None:
        self.executor = Watched()
        self._turns: SimpleQueue[list[Work]] = SimpleQueue()
        self._outcomes: SimpleQueue[tuple[int, str]] = SimpleQueue()
        self._over = False
        readers = ReaderThreads(
            self.executor,
            turn=lambda: self._turns.get(timeout=WAIT_S),
            answered=self._answered,
            wanted=lambda _: True,
            over=lambda: self._over,
        )
        self._thread = threading.Thread(target=readers.run, daemon=True)
        self._thread.start()

    def bring(self, *arguments: tuple[str, ...]) -> None:
        """Let one turn read one task for each of these arguments."""
        self._turns.put([_work(id, values) for id, values in enumerate(arguments)])

    def outcome(self) -> tuple[int, str]:
        return self._outcomes.get(timeout=WAIT_S)

    def close(self) -> None:
        self._over = True
        self._turns.put([])
        self._thread.join(WAIT_S)
        self.executor.close()

    def _answered(self, work: Work, outcome: Outcome) -> list[Work]:
        self._outcomes.put((work.request.id, outcome.status))
        return []


def _work(id: int, values: tuple[str, ...]) -> Work:
    request = Request(id, "read_short", WAIT_S, body=encode(values).frames)
    return Work(b"", request, {}, arrived=0.0, robot=b"")


@pytest.fixture
def reading(monkeypatch: pytest.MonkeyPatch) -> Iterator[Reading]:
    """Here each kind is short after its first task, on a slow computer too."""
    monkeypatch.setattr(reader_threads, "SHORT_S", 2 * WAIT_S)
    monkeypatch.setattr(reader_threads, "AWAY_S", AWAY_S)
    go.clear()
    made = Reading()
    yield made
    made.close()


def test_a_task_does_not_wait_behind_a_long_one_of_a_short_kind(reading: Reading) -> None:
    """One turn reads both. The second one runs on the free worker: the first one waits for it here."""
    reading.bring(("",))
    assert reading.outcome() == (0, "ok")
    reading.bring(("wait",), ("go",))
    assert {reading.outcome() for _ in range(2)} == {(0, "ok"), (1, "ok")}


def test_a_task_that_fails_does_not_make_its_kind_short(reading: Reading) -> None:
    """A request without its arguments fails at once; the next task of the kind is no short one."""
    reading.bring(())
    assert reading.outcome() == (0, "failed")
    reading.bring(("",))
    assert reading.outcome() == (0, "ok")
    assert reading.executor.hand_overs == [True, True]


def test_the_server_reads_on_after_no_thread_could_take_over(
    reading: Reading, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other work of the turn starts nevertheless; the thread that was away then reads again."""
    refused = threading.Event()

    def refuse(*_: object, **__: object) -> None:
        refused.set()
        raise RuntimeError("can't start new thread")

    reading.bring(("",))
    assert reading.outcome() == (0, "ok")
    with monkeypatch.context() as patch:
        for name in ("_start_new_thread", "_start_joinable_thread"):  # by the version of Python
            patch.setattr(threading, name, refuse, raising=False)
        reading.bring(("wait",), ("go",))
        assert refused.wait(WAIT_S)
        assert {reading.outcome() for _ in range(2)} == {(0, "ok"), (1, "ok")}
    reading.bring(("",))
    assert reading.outcome() == (0, "ok")
