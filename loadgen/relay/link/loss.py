"""Which segments of a stream are lost, and how long TCP stalls for each.

Pure: the draws of a segment are `draws.py`'s.
"""

import math

from offboard.loadgen.relay.link.draws import Draws, replay_from

LOSSES_MAX = (
    6  # of one segment; the stall doubles with each, as Linux's timer does: 63 times the first at most
)
LOSS_BURST_MAX = 10_000.0


class Loss:
    """Two states, good and lost, that a segment is in (Gilbert 1960, with all lost in the bad state).

    Bursts last `burst` segments in the mean, and the share `loss` of all segments is lost. A burst of 1 is
    independent loss, whose bursts by themselves last 1 / (1 - loss): shorter ones are not made.
    A lost segment's retransmissions come long after the burst, so each is lost by itself with `loss`.
    """

    def __init__(self, origin: str) -> None:
        self._draws = Draws(f"{origin}/loss")
        self._again = Draws(f"{origin}/retransmission")
        self._number = -1
        self._rates = (0.0, 1.0)
        self._lost = False

    def times(self, number: int, loss: float, burst: float) -> int:
        """How often this segment is lost, 0 to LOSSES_MAX, as if the rates had always been these."""
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
    """How much later a segment comes that was lost so often: the timer doubles each time."""
    return first_ms * ((1 << times) - 1)
