"""When tasks come and how big they are: pure, from specs and a seed; the one file read is a CSV of sizes."""

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
SIZE_MAX = 1e15  # a whole number that float64 holds exactly
SIGMA_MAX = 10.0
ROWS_MAX = 1_000_000
COLUMN = "size"

_DUE_STREAM, _SIZE_STREAM = 1, 2  # random streams of one seed, apart from the robot's
_NUMBERS = {"constant": 1, "uniform": 2, "lognormal": 2}
_ALLOWED = (
    "constant:X, uniform:LOW:HIGH, lognormal:MEDIAN:SIGMA or a CSV file with a size column; "
    "K= before it: from task K on"
)


@dataclass(frozen=True, slots=True)
class Phase:
    """Sizes from task `first` on: of a `shape` with its `numbers`, or the rows of `file`."""

    first: int
    shape: str | None
    numbers: tuple[float, ...] = ()
    file: Path | None = None


def due_instants(arrivals: str, rate: float, burst: int, seed: int) -> Iterator[float]:
    """When each task is due, in seconds after the first one, at `rate` tasks a second; without end.

    Constant and bursts are computed from the start, so nothing adds up.
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
    """The phases in their order; ConfigError names the spec that cannot be. No file is opened."""
    phases = sorted((_phase(spec) for spec in specs), key=lambda phase: phase.first)
    firsts = [phase.first for phase in phases]
    twice = [first for first, other in itertools.pairwise(firsts) if first == other]
    if twice:
        raise ConfigError(f"--sizes: {_joined(specs)}: more than one holds from task {twice[0]} on")
    if firsts and firsts[0] != 0:
        raise ConfigError(f"--sizes: {_joined(specs)}: none holds from task 0 on")
    return tuple(phases)


def sizes(phases: Sequence[Phase], seed: int) -> Iterator[float]:
    """The size of each task from task 0 on, without end; files are read before the first one.

    Each phase has a random stream of its own, so that changing one leaves the others as they are.
    """
    draws = [_draws(phase, _stream(seed, _SIZE_STREAM, n)) for n, phase in enumerate(phases)]
    lengths = [after.first - phase.first for phase, after in itertools.pairwise(phases)]
    parts = [itertools.islice(part, length) for part, length in zip(draws, lengths, strict=False)]
    return itertools.chain(*parts, draws[-1])


def _stream(*key: int) -> "np.random.Generator":
    import numpy as np  # where something is drawn: not for --help

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
        raise ConfigError(f"--sizes: {spec!r} is not {_ALLOWED}, with numbers from 0 to {SIZE_MAX:g}")
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
    # Of the logarithm: a median of 1e-300 with any sigma is still a number.
    return (min(math.exp(float(random.normal(math.log(median), sigma))), SIZE_MAX) for _ in itertools.count())


def _read_column(path: Path) -> list[float]:
    """The `size` column; DataError names file and line where a row has none."""
    import csv  # where a file is read: not for --help

    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            if COLUMN not in (rows.fieldnames or ()):
                raise DataError(f"--sizes: {path}:1: no column {COLUMN!r}")
            found = [_size(f"--sizes: {path}:{rows.line_num}", row[COLUMN]) for row in _bounded(path, rows)]
    except FileNotFoundError:
        raise DataError(f"--sizes: {str(path)!r} is not {_ALLOWED}") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"--sizes: {path}: {getattr(error, 'strerror', None) or error}") from error
    if not found:
        raise DataError(f"--sizes: {path}: no row after the header")
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


def _joined(specs: Sequence[str]) -> str:
    return ",".join(specs)
