"""Who reads: a caller who waits alone for his answer, else the thread; nobody waits in vain."""

import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import CancelledError

import pytest

from offboard.robot_client.sites import turns
from offboard.robot_client.sites.clock import SystemClock
from offboard.robot_client.sites.turns import Answer, Turns

LONG_S = 30.0  # what is lost is waited for as long


class Line:
    """Messages that arrive, each for one answer, and who read them."""

    def __init__(self) -> None:
        self.waiting: dict[int, Answer[int]] = {}
        self.unasked = 0  # messages that are expected, and that nobody waits for
        self.turns = Turns(
            self.tend,
            self.read,
            asked=self.waiting.__len__,
            expected=lambda: bool(self.waiting or self.unasked),
            wake=self.wake,
        )
        self.read_by: list[str] = []
        self.tended = 0
        self._arrived: deque[int] = deque()
        self._some = threading.Condition()
        self._woken = False
        self.thread = threading.Thread(target=self.turns.run, args=(LONG_S,), name="thread", daemon=True)

    def ask(self, n: int) -> Answer[int]:
        answer = self.waiting[n] = Answer(self.turns)
        return answer

    def arrive(self, n: int) -> None:
        with self._some:
            self._arrived.append(n)
            self._some.notify_all()

    def arrive_later(self, n: int) -> None:
        threading.Timer(0.02, self.arrive, (n,)).start()

    def wake(self) -> None:
        with self._some:
            self._woken = True
            self._some.notify_all()

    def tend(self) -> None:
        self.tended += 1

    def read(self, wait_s: float) -> None:
        with self._some:
            self._some.wait_for(lambda: self._woken or self._arrived, min(wait_s, LONG_S))
            self._woken = False
            while self._arrived:
                n = self._arrived.popleft()
                self.read_by.append(threading.current_thread().name)
                self.waiting.pop(n).set_result(n)

    def answered(self, n: int) -> int:
        """Ask, and wait alone."""
        answer = self.ask(n)
        self.arrive_later(n)
        return answer.result(LONG_S)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """The thread never comes back by itself, unless a test says so."""
    monkeypatch.setattr(turns, "LINGER_S", LONG_S)
    line = Line()
    line.thread.start()
    yield line
    line.turns.close()
    line.thread.join(LONG_S)
    assert not line.thread.is_alive()


ME = threading.current_thread().name


def test_who_waits_alone_reads_himself(line: Line) -> None:
    """The thread has the first turn and makes way for the next ones."""
    assert [line.answered(n) for n in range(5)] == list(range(5))
    assert line.read_by == ["thread"] + 4 * [ME]


def test_the_thread_reads_for_several(line: Line) -> None:
    """Who waits for one of two answers leaves the reading to it, and is not late."""
    line.answered(0), line.answered(1)
    first, second = line.ask(2), line.ask(3)
    line.arrive_later(3)
    assert second.result(LONG_S) == 3
    line.arrive_later(2)
    assert first.exception(LONG_S) is None
    assert line.read_by[2:] == ["thread", "thread"]


def test_who_waits_alone_reads_what_nobody_waits_for_too(line: Line) -> None:
    """As the answer to a heartbeat; where that comes later than his own the thread reads it."""
    line.answered(0), line.answered(1)
    line.unasked = 1
    assert line.answered(2) == 2
    assert line.read_by[2:] == [ME]
    line.waiting[3] = unasked = Answer[int](line.turns)
    heard = threading.Event()
    unasked.add_done_callback(lambda _: heard.set())
    line.arrive(3)
    assert heard.wait(LONG_S)
    assert line.read_by[3:] == ["thread"]


def test_the_thread_reads_for_who_waits_for_anything_else_too(line: Line) -> None:
    """As for a race of two sites."""
    line.answered(0), line.answered(1)
    answer, other = line.ask(2), Answer[int](line.turns)
    line.arrive_later(2)
    SystemClock().wait([answer, other], LONG_S)
    assert answer.done()
    assert line.read_by[2:] == ["thread"]


def test_the_thread_takes_over_what_a_caller_leaves(line: Line) -> None:
    """Whoever gave up waiting, or whose answer came before another one's, leaves nothing unread."""
    line.answered(0), line.answered(1)
    late = line.ask(2)
    with pytest.raises(TimeoutError):
        late.result(0.01)
    taken = threading.Event()
    late.add_done_callback(lambda _: taken.set())
    line.arrive(2)
    assert taken.wait(LONG_S)
    assert line.read_by[2:] == ["thread"]


def test_what_is_to_be_done_at_once_is_done_while_a_caller_reads(line: Line) -> None:
    """He is woken, and tends to it before he reads on."""
    line.answered(0), line.answered(1)
    answer, before = line.ask(2), line.tended
    threading.Timer(0.02, line.turns.call).start()
    threading.Timer(0.1, line.arrive, (2,)).start()
    assert answer.result(LONG_S) == 2
    assert line.tended >= before + 2


def test_the_thread_comes_back_when_no_caller_reads(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    """What nobody asked for, as that the connection is gone, is read after LINGER_S."""
    line.answered(0), line.answered(1)
    monkeypatch.setattr(turns, "LINGER_S", 0.01)
    line.turns.call()
    line.waiting[2] = unasked = Answer[int](line.turns)
    line.arrive(2)
    SystemClock().wait([unasked, Answer[int](line.turns)], LONG_S)
    assert line.read_by[2:] == ["thread"]


def test_a_caller_who_reads_is_let_go_at_the_end(line: Line) -> None:
    """Close ends his turn; who still waits is told by whoever closed."""
    line.answered(0), line.answered(1)
    answer = line.ask(2)

    def close() -> None:
        line.turns.close()
        with line.turns.taken:
            answer.cancel()

    threading.Timer(0.02, close).start()
    with pytest.raises(CancelledError):
        answer.result(LONG_S)
