"""Who reads the socket: a caller that waits alone, otherwise the thread; no answer is left unread."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent import futures
from concurrent.futures import CancelledError

import pytest

from offboard.robot_client.sites import waiting
from offboard.robot_client.sites.waiting import Answer, SharedReader, SystemClock

LONG_S = 30.0  # a test that loses an answer fails after this time


class Line:
    """Messages that arrive, each the answer to one question, and who reads them."""

    def __init__(self) -> None:
        self.waiting: dict[int, Answer[int]] = {}
        self.unasked = 0  # messages that are expected although no caller waits for them
        self.reader = SharedReader(
            self.tend,
            self.read,
            unanswered=self.waiting.__len__,
            expects_message=lambda: bool(self.waiting or self.unasked),
            wake=self.wake,
        )
        self.read_by: list[str] = []
        self.tended = 0
        self._arrived: deque[int] = deque()
        self._changed = threading.Condition()
        self._woken = False
        self.thread = threading.Thread(target=self.reader.run, args=(LONG_S,), name="thread", daemon=True)

    def ask(self, n: int) -> Answer[int]:
        answer = self.waiting[n] = Answer(self.reader)
        return answer

    def arrive(self, n: int) -> None:
        with self._changed:
            self._arrived.append(n)
            self._changed.notify_all()

    def arrive_later(self, n: int) -> None:
        threading.Timer(0.02, self.arrive, (n,)).start()

    def wake(self) -> None:
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def tend(self) -> None:
        self.tended += 1

    def read(self, wait_s: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._woken or self._arrived, min(wait_s, LONG_S))
            self._woken = False
            while self._arrived:
                n = self._arrived.popleft()
                self.read_by.append(threading.current_thread().name)
                self.waiting.pop(n).set_result(n)

    def answered(self, n: int) -> int:
        """Ask one question, and wait for its answer alone."""
        answer = self.ask(n)
        self.arrive_later(n)
        return answer.result(LONG_S)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """A line whose thread stays away once callers read, unless a test calls it back."""
    monkeypatch.setattr(waiting, "LINGER_S", LONG_S)
    line = Line()
    line.thread.start()
    yield line
    line.reader.close()
    line.thread.join(LONG_S)
    assert not line.thread.is_alive()


CALLER = threading.current_thread().name


def test_a_caller_that_waits_alone_reads(line: Line) -> None:
    """The thread has the first turn and leaves the next ones to the caller."""
    assert [line.answered(n) for n in range(5)] == list(range(5))
    assert line.read_by == ["thread"] + 4 * [CALLER]


def test_the_thread_reads_if_two_answers_are_due(line: Line) -> None:
    """A caller that waits for one of two answers leaves the reading to the thread, and gets both."""
    line.answered(0), line.answered(1)
    first, second = line.ask(2), line.ask(3)
    line.arrive_later(3)
    assert second.result(LONG_S) == 3
    line.arrive_later(2)
    assert first.exception(LONG_S) is None
    assert line.read_by[2:] == ["thread", "thread"]


def test_a_caller_reads_other_messages_too(line: Line) -> None:
    """The caller also reads the answer to a heartbeat; if that comes after its own, the thread reads it."""
    line.answered(0), line.answered(1)
    line.unasked = 1
    assert line.answered(2) == 2
    assert line.read_by[2:] == [CALLER]
    line.waiting[3] = unasked = Answer[int](line.reader)
    heard = threading.Event()
    unasked.add_done_callback(lambda _: heard.set())
    line.arrive(3)
    assert heard.wait(LONG_S)
    assert line.read_by[3:] == ["thread"]


def test_the_thread_reads_if_the_caller_waits_for_two_sites(line: Line) -> None:
    """The caller of a race waits for several futures, so it cannot read one socket."""
    line.answered(0), line.answered(1)
    answer, other = line.ask(2), Answer[int](line.reader)
    line.arrive_later(2)
    SystemClock().wait([answer, other], LONG_S)
    assert answer.done()
    assert line.read_by[2:] == ["thread"]


def test_the_thread_reads_what_a_caller_no_longer_waits_for(line: Line) -> None:
    """An answer that comes after its caller gave up is read."""
    line.answered(0), line.answered(1)
    late = line.ask(2)
    with pytest.raises(futures.TimeoutError):
        late.result(0.01)
    taken = threading.Event()
    late.add_done_callback(lambda _: taken.set())
    line.arrive(2)
    assert taken.wait(LONG_S)
    assert line.read_by[2:] == ["thread"]


def test_an_interrupt_reaches_a_caller_that_reads(line: Line) -> None:
    """The caller wakes up, does what is due, and reads on."""
    line.answered(0), line.answered(1)
    answer, before = line.ask(2), line.tended

    def interrupt() -> None:
        wait_until(lambda: line.tended > before)
        line.reader.interrupt()
        wait_until(lambda: line.tended > before + 1)
        line.arrive(2)

    threading.Thread(target=interrupt, daemon=True).start()
    assert answer.result(LONG_S) == 2
    assert line.tended >= before + 2


def wait_until(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LONG_S
    while not holds() and time.monotonic() < end_s:
        time.sleep(0.001)


def test_the_thread_comes_back_when_no_caller_reads(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    """After LINGER_S the thread reads what no caller asked for, for example that the connection is lost."""
    line.answered(0), line.answered(1)
    monkeypatch.setattr(waiting, "LINGER_S", 0.01)
    line.reader.interrupt()
    line.waiting[2] = unasked = Answer[int](line.reader)
    line.arrive(2)
    SystemClock().wait([unasked, Answer[int](line.reader)], LONG_S)
    assert line.read_by[2:] == ["thread"]


def test_closing_ends_the_turn_of_a_caller(line: Line) -> None:
    """After `close` the caller stops reading, and the owner of the reader can cancel its answer."""
    line.answered(0), line.answered(1)
    answer = line.ask(2)

    def close() -> None:
        line.reader.close()
        with line.reader.turn:
            answer.cancel()

    threading.Timer(0.02, close).start()
    with pytest.raises(CancelledError):
        answer.result(LONG_S)
