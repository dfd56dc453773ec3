"""What is drawn at random for the segments of a byte stream: their jitter, and which of them are lost.

Pure: a draw depends only on the seed and the number of the segment, in whatever order segments are asked for.
What the draws do to bytes is put together in `pipe.py`.
"""

import math
import random
from collections.abc import Callable, Sequence
from statistics import NormalDist

SAMPLES = "samples"  # the name of the distribution of measured delays
REPLAY_MAX = 100_000  # segments that are drawn again at most, which takes about 40 ms
_SKIP = 1 << 16  # numbers skipped at a time
_FLOAT_BITS = 64  # that one float takes from the generator
# Losses of one segment at most. The stall doubles with each loss, as the retransmission timer of Linux
# does, so the longest stall is 63 times the first.
LOSSES_MAX = 6
LOSS_BURST_MAX = 10_000.0
PARETO_SHAPE = 3.0
PARETO_SD = math.sqrt(PARETO_SHAPE / (PARETO_SHAPE - 2)) / (PARETO_SHAPE - 1)
LOGNORMAL_SD = math.sqrt((math.e - 1) * math.e)
_NORMAL = NormalDist()

# Each distribution maps a uniform draw in (0, 1) to a deviation. The deviation times jitter_ms is added to
# the delay. The standard deviation is 1, with two exceptions: "constant" always adds jitter_ms, and
# "uniform" has a half width of 1, as in netem. "pareto" and "lognormal" have the long tail of queues and
# radio links: a segment is never early and sometimes very late.
DISTRIBUTIONS: dict[str, Callable[[float], float]] = {
    "constant": lambda _: 1.0,
    "uniform": lambda u: 2 * u - 1,
    "normal": _NORMAL.inv_cdf,
    "pareto": lambda u: ((1 - u) ** (-1 / PARETO_SHAPE) - 1) / PARETO_SD,
    "lognormal": lambda u: math.exp(_NORMAL.inv_cdf(u)) / LOGNORMAL_SD,
}


class Jitter:
    """One uniform draw for each segment, which may be correlated with the draw of the segment before.

    The correlation is an AR(1) process on the normal scores of the draws (a Gaussian copula). Each draw by
    itself stays uniform, so the delays keep their distribution; the normal scores of neighbouring segments
    have exactly the requested correlation. netem mixes the uniform numbers instead, which changes the
    distribution.
    """

    def __init__(self, origin: str) -> None:
        self._draws = Draws(origin)
        self._number = -1
        self._correlation = 0.0
        self._score = 0.0

    def at(self, number: int, correlation: float = 0.0) -> float:
        """The draw of this segment, as if the correlation had been the same since the first segment."""
        if correlation in (0, 1):
            return self._draws.at(0 if correlation else number)
        if (number, correlation) != (self._number, self._correlation):
            self._advance(number, correlation)
        return min(max(_NORMAL.cdf(self._score), 2**-53), 1 - 2**-53)

    def _advance(self, number: int, correlation: float) -> None:
        first = number
        if (number, correlation) != (self._number + 1, self._correlation):
            first = replay_from(number, correlation)
            self._score = _NORMAL.inv_cdf(self._draws.at(first))
            first += 1
        fresh = math.sqrt(1 - correlation**2)
        for n in range(first, number + 1):
            self._score = correlation * self._score + fresh * _NORMAL.inv_cdf(self._draws.at(n))
        self._number, self._correlation = number, correlation


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


def quantile(ordered: Sequence[float], draw: float) -> float:
    """The delay at a uniform draw in (0, 1); each of the sorted delays is equally likely."""
    return ordered[min(int(draw * len(ordered)), len(ordered) - 1)]


class Draws:
    """One uniform number in (0, 1) for each segment.

    `origin` is the seed: another origin gives independent numbers.
    """

    def __init__(self, origin: str) -> None:
        self._origin = origin
        self._random: random.Random | None = None  # made when it is needed: many connections never draw
        self._number = -1
        self._value = 0.5

    def at(self, number: int) -> float:
        """The number of this segment. Going forward is fast, going back starts again from the seed."""
        if self._random is None or number < self._number:
            self._random, self._number = random.Random(self._origin), -1
        if number != self._number:
            skipped = number - self._number - 1
            while skipped:
                part = min(skipped, _SKIP)
                self._random.getrandbits(_FLOAT_BITS * part)
                skipped -= part
            # Distributions have infinite quantiles at 0 and 1.
            self._value, self._number = min(1 - self._random.random(), 1 - 2**-53), number
        return self._value


def replay_from(number: int, memory: float) -> int:
    """The segment from which a random process must be replayed to know its state at segment `number`.

    `memory` is the share of its state that the process keeps from one segment to the next. Earlier segments
    change the state by less than a rounding error. Only a memory above 0.9996 is cut short, by REPLAY_MAX.
    """
    if memory <= 0:
        return number
    steps = REPLAY_MAX if memory >= 1 else min(REPLAY_MAX, math.ceil(math.log(2**-53) / math.log(memory)))
    return max(0, number - steps)
