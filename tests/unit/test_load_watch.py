"""Reading the load in a background thread."""

import threading
from pathlib import Path
from queue import SimpleQueue

from offboard.common.load import EVERY_S, Load, LoadWatch

WAIT_S = 8.0


class Counted(Load):
    """Its load is the number of readings so far; `read_by` gets the thread of each reading."""

    def __init__(self) -> None:
        super().__init__(Path("/proc/self"))
        self.read_by: SimpleQueue[threading.Thread] = SimpleQueue()
        self._count = 0

    def share(self, every_s: float = EVERY_S) -> float:  # noqa: ARG002
        self._count += 1
        self.read_by.put(threading.current_thread())
        return float(self._count)


def test_only_the_first_reading_is_in_the_callers_thread() -> None:
    """Nothing is read before `latest` is called; from then on a thread reads, until `close`."""
    counted = Counted()
    watch = LoadWatch(counted, 0.001)
    assert counted.read_by.empty()
    assert watch.latest()[0] >= 1
    assert counted.read_by.get(timeout=WAIT_S) is threading.current_thread()
    reader = counted.read_by.get(timeout=WAIT_S)
    assert reader is not threading.current_thread()
    assert counted.read_by.get(timeout=WAIT_S) is reader
    watch.close()
    reader.join(WAIT_S)
    assert not reader.is_alive()


def test_a_hurried_watch_reads_in_the_callers_thread() -> None:
    """`hurry` reads at once, but not before the first `latest`."""
    counted = Counted()
    watch = LoadWatch(counted, 60.0)
    watch.hurry()
    assert counted.read_by.empty()
    watch.latest()
    watch.hurry()
    readers = [counted.read_by.get(timeout=WAIT_S) for _ in range(2)]
    assert readers == [threading.current_thread()] * 2
    watch.close()


def test_a_watch_that_nobody_asks_reads_less_often() -> None:
    """A server that is idle reads as often as a robot; once it is asked, it reads at its own pace again."""
    pauses, goes_on = SimpleQueue[float](), threading.Semaphore(0)

    def pause_s(usual_s: float) -> float:
        pauses.put(usual_s)
        goes_on.acquire(timeout=WAIT_S)
        return 0.0

    watch = LoadWatch(Counted(), 0.01, pause_s)
    watch.latest()
    assert pauses.get(timeout=WAIT_S) == 0.01
    goes_on.release()
    assert pauses.get(timeout=WAIT_S) == EVERY_S
    watch.latest()
    goes_on.release()
    assert pauses.get(timeout=WAIT_S) == 0.01
    watch.close()
    goes_on.release()
