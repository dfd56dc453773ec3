"""Random delay: the named distributions, and the correlation between neighbouring segments.

Measured delays are read by `delay_samples.py`; the whole delay of a segment is put together in `delay.py`.
"""

import math
from collections.abc import Callable
from statistics import NormalDist

from offboard.loadgen.relay.link.draws import Draws, replay_from

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
