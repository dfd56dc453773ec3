"""How much later than the delay a segment comes: named distributions, measured samples, and correlation.

Pure: the draws of a segment are `draws.py`'s, what is made of them is `link.py`'s.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import NormalDist

from offboard.common.errors import DataError
from offboard.loadgen.relay.link.draws import Draws, replay_from

DELAY_MS_MAX = 60_000.0
SAMPLES = "samples"  # the distribution that is a file, not a formula
SAMPLES_MAX = 20_000

PARETO_SHAPE = 3.0
PARETO_SD = math.sqrt(PARETO_SHAPE / (PARETO_SHAPE - 2)) / (PARETO_SHAPE - 1)
LOGNORMAL_SD = math.sqrt((math.e - 1) * math.e)
_NORMAL = NormalDist()

# Each maps one uniform draw in (0, 1) to a deviation; times jitter_ms it is what the delay grows by.
# Standard deviation 1, but for constant (always late by jitter_ms) and uniform (half width 1, as netem).
# Pareto and log-normal have the long tail of queues and radio links: never early, sometimes very late.
DISTRIBUTIONS: dict[str, Callable[[float], float]] = {
    "constant": lambda _: 1.0,
    "uniform": lambda u: 2 * u - 1,
    "normal": _NORMAL.inv_cdf,
    "pareto": lambda u: ((1 - u) ** (-1 / PARETO_SHAPE) - 1) / PARETO_SD,
    "lognormal": lambda u: math.exp(_NORMAL.inv_cdf(u)) / LOGNORMAL_SD,
}


class Jitter:
    """One uniform draw a segment, correlated with the draw before as far as is asked.

    Correlation is an AR(1) process on the normal scores of the draws (a Gaussian copula), so each draw by
    itself stays uniform and the delays keep their distribution. netem mixes the uniform numbers themselves,
    which narrows and bends it. The normal scores of neighbouring segments correlate by exactly this much.
    """

    def __init__(self, origin: str) -> None:
        self._draws = Draws(origin)
        self._number = -1
        self._correlation = 0.0
        self._score = 0.0

    def at(self, number: int, correlation: float = 0.0) -> float:
        """The draw of this segment, as if the correlation had been the same from the first one on."""
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


class Samples(tuple[float, ...]):
    """Delays in ms that were checked, in rising order."""

    __slots__ = ()


def quantile(ordered: Sequence[float], draw: float) -> float:
    """The value of a sample (in rising order) at a uniform draw: each value is equally likely."""
    return ordered[min(int(draw * len(ordered)), len(ordered) - 1)]


def read_samples(path: Path) -> Samples:
    """Delays in ms, one a line, in rising order; DataError names file, line and value."""
    try:
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    samples: list[float] = []
    for number, text in enumerate(lines, 1):
        if not (text := text.strip()):
            continue
        if len(samples) == SAMPLES_MAX:
            raise DataError(f"{path}:{number}: {text!r} is one too many, at most {SAMPLES_MAX} are allowed")
        samples.append(_delay_ms(path, number, text))
    if not samples:
        raise DataError(f"{path}: holds no delays")
    return Samples(sorted(samples))


def _delay_ms(path: Path, number: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= DELAY_MS_MAX:
        raise DataError(f"{path}:{number}: {text!r} is not a delay in ms from 0 to {DELAY_MS_MAX:g}")
    return value
