"""What the background work of a robot must know of its tasks: both need the same CPU.

On a tenth of a CPU, or next to a library that holds the interpreter's lock, a robot that computes hears late
from other sites.
"""

import time

LOADED_SLOWER = 3  # times as long are the pauses of background work on a loaded robot


class Background:
    """Shared by all runners of one offloader.

    loaded: other programs take so much of the CPU that measured times show it.
    """

    def __init__(self) -> None:
        self.loaded = False
        self._computing = 0
        self._computed_s = float("-inf")  # when a run onboard last ended

    def pause_s(self, usual_s: float) -> float:
        """The seconds to wait before the next step of work that is usually done this often."""
        return LOADED_SLOWER * usual_s if self.loaded else usual_s

    def begin(self) -> None:
        """A run onboard begins. Called under the lock of the onboard runner, like `end`."""
        self._computing += 1

    def end(self) -> None:
        self._computing -= 1
        self._computed_s = time.perf_counter()

    def computed_since(self, at_s: float) -> bool:
        """Whether a task ran onboard at this time of `time.perf_counter`, or later."""
        return self._computing > 0 or self._computed_s >= at_s
