"""What takes the CPU of this process, which then hears late from other sites.

All threads of the process share the interpreter's lock and, under a quota, its CPU time. While a task runs
onboard, the times that the robot measures of a server are too long, by 10 to 50 ms on a tenth of a CPU.
"""

import threading

LOADED_SLOWER = 3  # on a loaded robot, pauses in background work are this many times as long
LATE_MAX = 2.0  # times the expected time: a run onboard does not explain a longer delay


def may_be_late(seconds: float, expected_s: float | None) -> bool:
    """Whether it took no longer than a run onboard at the same time may explain."""
    return expected_s is not None and seconds <= LATE_MAX * expected_s


class OwnCpu:
    """Knows whether a task ran onboard since a given time, on the clock of `time.perf_counter`.

    loaded: other programs take so much of the CPU that measured times show it.
    """

    def __init__(self) -> None:
        self.loaded = False
        self._running = 0
        self._ended_s = float("-inf")
        self._lock = threading.Lock()

    def pause_s(self, usual_s: float) -> float:
        """The pause between two steps of background work, which takes CPU from the tasks."""
        return LOADED_SLOWER * usual_s if self.loaded else usual_s

    def begin(self) -> None:
        with self._lock:
            self._running += 1

    def end(self, now_s: float) -> None:
        with self._lock:
            self._running -= 1
            self._ended_s = now_s

    def since(self, at_s: float) -> bool:
        """Whether a task ran onboard at this time or later."""
        return self._running > 0 or self._ended_s >= at_s


OWN_CPU = OwnCpu()  # of this process
