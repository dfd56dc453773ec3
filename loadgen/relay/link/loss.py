"""Packet loss: which segments of a byte stream are lost, and how long TCP stalls for each of them.

Pure. The random numbers come from `draws.py`.
"""

import math

from offboard.loadgen.relay.link.draws import Draws, replay_from

# Losses of one segment at most. The stall doubles with each loss, as the retransmission timer of Linux
# does, so the longest stall is 63 times the first.
LOSSES_MAX = 6
LOSS_BURST_MAX = 10_000.0


class Loss:
    """A process with two states, good and lost (Gilbert 1960; every segment of the bad state is lost).

    The share `loss` of all segments is lost, in bursts of `burst` segments on average. A burst of 1 means
    independent losses. Their bursts have a mean length of 1 / (1 - loss); the process makes none shorter.
    The retransmissions of a lost segment come long after the burst, so each of them is lost independently,
    with probability `loss`.
    """

    def __init__(self, origin: str) -> None:
        self._draws = Draws(f"{origin}/loss")
        self._again = Draws(f"{origin}/retransmission")
        self._number = -1
        self._rates = (0.0, 1.0)
        self._lost = False

    def times(self, number: int, loss: float, burst: float) -> int:
        """How many times this segment is lost, as if the rates had been the same since the first segment."""
        if not loss or not self._is_lost(number, loss, burst):
            return 0
        again = math.log(self._again.at(number)) / math.log(loss) if loss < 1 else LOSSES_MAX
        return min(1 + int(again), LOSSES_MAX)

    def _is_lost(self, number: int, loss: float, burst: float) -> bool:
        ends = min(1 / burst, 1 - loss)
        begins = ends * loss / (1 - loss) if loss < 1 else 1.0
        first = number
        if (number, (loss, burst)) != (self._number + 1, self._rates):
            first = replay_from(number, 1 - ends - begins)
            self._lost = self._draws.at(first) < loss
            first += 1
        for n in range(first, number + 1):
            self._lost = self._draws.at(n) < (1 - ends if self._lost else begins)
        self._number, self._rates = number, (loss, burst)
        return self._lost


def stall_ms(times: int, first_ms: float) -> float:
    """How long TCP stalls for a segment that is lost `times` times: the timer doubles with each loss."""
    return first_ms * ((1 << times) - 1)
