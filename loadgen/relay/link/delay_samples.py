"""Measured delays, read from a file, that replace the named distributions of jitter.

Which of them a segment gets is drawn in `jitter.py`.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from offboard.common.errors import DataError

DELAY_MS_MAX = 60_000.0
SAMPLES = "samples"  # the name of the distribution that these delays are
SAMPLES_MAX = 20_000


class Samples(tuple[float, ...]):
    """Delays in ms, checked and sorted."""

    __slots__ = ()


def quantile(ordered: Sequence[float], draw: float) -> float:
    """The delay at a uniform draw in (0, 1); each of the sorted delays is equally likely."""
    return ordered[min(int(draw * len(ordered)), len(ordered) - 1)]


def read_samples(path: Path) -> Samples:
    """The delays of a file, one in each line, in ms; DataError names file, line and value."""
    try:
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    samples: list[float] = []
    for number, text in enumerate(lines, 1):
        if not (text := text.strip()):
            continue
        if len(samples) == SAMPLES_MAX:
            raise DataError(
                f"{path}:{number}: {text!r} is one delay too many; at most {SAMPLES_MAX} are allowed"
            )
        samples.append(_delay_ms(path, number, text))
    if not samples:
        raise DataError(f"{path}: the file holds no delays")
    return Samples(sorted(samples))


def _delay_ms(path: Path, number: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= DELAY_MS_MAX:
        raise DataError(f"{path}:{number}: {text!r} is not a delay in ms from 0 to {DELAY_MS_MAX:g}")
    return value
