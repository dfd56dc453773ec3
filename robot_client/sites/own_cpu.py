"""What takes the CPU of this process: it is slow to hear of other sites meanwhile.

All of its threads share the interpreter's lock and, under a quota, its CPU time. What it measures of a server
then is too long, by 10 to 50 ms on a tenth of a CPU.
"""

import threading

LOADED_SLOWER = 3  # times as rarely is done what a loaded robot does beside its tasks
LATE_MAX = 2.0  # times as long as expected: what takes longer still is late for another reason


def may_be_late(seconds: float, expected_s: float | None) -> bool:
    """Whether own runs may be why it took longer than expected, or it took no longer."""
    return expected_s is not None and seconds <= LATE_MAX * expected_s


class OwnCpu:
    """Whether any run was under way since some time, on the clock of `time.perf_counter`.

    `loaded`: others take so much of the CPU that what is measured tells of them.
    """

    def __init__(self) -> None:
        self.loaded = False
        self._running = 0
        self._ended_s = float("-inf")
        self._lock = threading.Lock()

    def pause_s(self, usual_s: float) -> float:
        """Until what is done again and again beside the tasks, whose CPU it takes, is done again."""
        return LOADED_SLOWER * usual_s if self.loaded else usual_s

    def begin(self) -> None:
        with self._lock:
            self._running += 1

    def end(self, now_s: float) -> None:
        with self._lock:
            self._running -= 1
            self._ended_s = now_s

    def since(self, at_s: float) -> bool:
        """Whether there was one from then on, if only for its last moment."""
        return self._running > 0 or self._ended_s >= at_s


OWN_CPU = OwnCpu()  # of this process
