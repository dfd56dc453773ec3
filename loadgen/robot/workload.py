"""When tasks arrive and which input sizes they have, computed from specs and a seed.

The only file that is read here is a CSV file of sizes. What the tasks are is defined in `work`.
"""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from offboard.common.errors import ConfigError, DataError

if TYPE_CHECKING:
    import csv

    import numpy as np

CLOSED, CONSTANT, POISSON, BURSTS = "closed", "constant", "poisson", "bursts"
ARRIVALS = (CLOSED, CONSTANT, POISSON, BURSTS)
SIZE_MAX = 1e15  # float64 holds every whole number up to here exactly
SIGMA_MAX = 10.0
ROWS_MAX = 1_000_000
COLUMN = "size"

_DUE_STREAM, _SIZE_STREAM = 1, 2  # so that arrivals, sizes and the robot draw from different random streams
_NUMBERS = {"constant": 1, "uniform": 2, "lognormal": 2}
SIZES_ALLOWED = (
    "constant:X, uniform:LOW:HIGH, lognormal:MEDIAN:SIGMA or a CSV file with a size column; "
    "K=SPEC holds from task K on"
)


@dataclass(frozen=True, slots=True)
class Phase:
    """The sizes from task `first` on: drawn from a `shape` with its `numbers`, or read from `file`."""

    first: int
    shape: str | None
    numbers: tuple[float, ...] = ()
    file: Path | None = None


def due_instants(arrivals: str, rate: float, burst: int, seed: int) -> Iterator[float]:
    """When each task is due, in seconds after the first one, at `rate` tasks per second; endless.

    Constant arrivals and bursts are computed from the start instant, so that rounding errors do not add up.
    """
    if arrivals == CONSTANT:
        yield from (n / rate for n in itertools.count())
    elif arrivals == BURSTS:
        yield from (n // burst * burst / rate for n in itertools.count())
    else:
        assert arrivals == POISSON, arrivals
        random, due_s = _stream(seed, _DUE_STREAM), 0.0
        while True:
            yield due_s
            due_s += float(random.exponential(1 / rate))


def parse_sizes(specs: Sequence[str]) -> tuple[Phase, ...]:
    """The phases in the order of their tasks; a ConfigError names a wrong spec. No file is opened."""
    phases = sorted((_phase(spec) for spec in specs), key=lambda phase: phase.first)
    firsts = [phase.first for phase in phases]
    twice = [first for first, other in itertools.pairwise(firsts) if first == other]
    if twice:
        raise ConfigError(f"--sizes: {','.join(specs)}: more than one spec holds from task {twice[0]} on")
    if firsts and firsts[0] != 0:
        raise ConfigError(f"--sizes: {','.join(specs)}: no spec holds from task 0 on")
    return tuple(phases)


def sizes(phases: Sequence[Phase], seed: int) -> Iterator[float]:
    """The size of each task from task 0 on, endless. Files are read before the first size is returned.

    Each phase has its own random stream, so that a change of one phase does not change the others.
    """
    draws = [_draws(phase, _stream(seed, _SIZE_STREAM, n)) for n, phase in enumerate(phases)]
    lengths = [after.first - phase.first for phase, after in itertools.pairwise(phases)]
    parts = [itertools.islice(part, length) for part, length in zip(draws, lengths, strict=False)]
    return itertools.chain(*parts, draws[-1])


def _stream(*key: int) -> "np.random.Generator":
    import numpy as np  # not for --help

    return np.random.default_rng(key)


def _phase(spec: str) -> Phase:
    start = re.match(r"(\d{1,9})=", spec)
    first, rest = (int(start[1]), spec[start.end() :]) if start else (0, spec)
    shape, *words = rest.split(":")
    if shape not in _NUMBERS:
        return Phase(first, None, file=Path(rest))
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != _NUMBERS[shape] or not all(0 <= number <= SIZE_MAX for number in numbers):
        raise ConfigError(f"--sizes: {spec!r} is not {SIZES_ALLOWED}, with numbers from 0 to {SIZE_MAX:g}")
    if shape == "uniform" and numbers[0] > numbers[1]:
        raise ConfigError(f"--sizes: {spec!r}: LOW {numbers[0]:g} is above HIGH {numbers[1]:g}")
    if shape == "lognormal" and not (numbers[0] > 0 and numbers[1] <= SIGMA_MAX):
        raise ConfigError(f"--sizes: {spec!r}: MEDIAN is above 0 and SIGMA at most {SIGMA_MAX:g}")
    return Phase(first, shape, numbers)


def _draws(phase: Phase, random: "np.random.Generator") -> Iterator[float]:
    if phase.file is not None:
        return itertools.cycle(_read_column(phase.file))
    if phase.shape == "constant":
        return itertools.repeat(phase.numbers[0])
    if phase.shape == "uniform":
        low, high = phase.numbers
        return (float(random.uniform(low, high)) for _ in itertools.count())
    median, sigma = phase.numbers
    # The normal draw is around the logarithm, so that a median of 1e-300 works with any sigma.
    return (min(math.exp(float(random.normal(math.log(median), sigma))), SIZE_MAX) for _ in itertools.count())


def _read_column(path: Path) -> list[float]:
    """The `size` column; a DataError names the file and the line of a row without a size."""
    import csv  # not for --help

    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            if COLUMN not in (rows.fieldnames or ()):
                raise DataError(f"--sizes: {path}:1: there is no column {COLUMN!r}")
            found = [_size(f"--sizes: {path}:{rows.line_num}", row[COLUMN]) for row in _bounded(path, rows)]
    except FileNotFoundError:
        raise DataError(f"--sizes: {str(path)!r} is not {SIZES_ALLOWED}") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"--sizes: {path}: {getattr(error, 'strerror', None) or error}") from error
    if not found:
        raise DataError(f"--sizes: {path}: there is no row after the header")
    return found


def _bounded(path: Path, rows: "csv.DictReader[str]") -> Iterator[dict[str, str]]:
    for number, row in enumerate(rows):
        if number == ROWS_MAX:
            raise DataError(f"--sizes: {path}: more than {ROWS_MAX} rows")
        yield row


def _size(where: str, text: str | None) -> float:
    try:
        size = float(text or "")
    except ValueError:
        size = math.nan
    if not 0 <= size <= SIZE_MAX:
        raise DataError(f"{where}: {COLUMN}: {text!r} is not a number from 0 to {SIZE_MAX:g}")
    return size
