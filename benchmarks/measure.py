"""What every table is made of: cases in turn, their medians, and bars that hold or do not."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

ROUNDS = 15


@dataclass(frozen=True, slots=True)
class Bar:
    """A figure that should be at most, or at least, its limit."""

    what: str
    value: float
    limit: float
    unit: str = ""
    at_least: bool = False

    @property
    def holds(self) -> bool:
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    def __str__(self) -> str:
        side = "at least" if self.at_least else "at most"
        verdict = "holds" if self.holds else "**fails**"
        return f"{self.what}: {self.value:.3g}{self.unit}, {side} {self.limit:g}{self.unit}: {verdict}"


@dataclass(frozen=True, slots=True)
class Table:
    """Title, columns and rows as printed, the bars that follow from them, and what could not be measured."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    bars: Sequence[Bar] = ()
    missing: Sequence[str] = ()

    def __str__(self) -> str:
        lines = [f"## {self.title}", "", f"| {' | '.join(self.columns)} |"]
        lines.append("| " + " | ".join("---" for _ in self.columns) + " |")
        lines += [f"| {' | '.join(row)} |" for row in self.rows]
        lines += [
            "",
            *(f"- {bar}" for bar in self.bars),
            *(f"- not measured: {what}" for what in self.missing),
        ]
        return "\n".join(lines).rstrip() + "\n"


def interleaved(cases: Mapping[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Median seconds of each case: each round runs all of them once, every other one backwards.

    A first round is not counted.
    """
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for number in range(rounds + 1):
        for name in list(cases) if number % 2 else reversed(cases):
            began = time.perf_counter()
            cases[name]()
            if number:
                seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(each) for name, each in seconds.items()}


def each_of(
    cases: Mapping[str, Callable[[int], object]], count: int, rounds: int = ROUNDS
) -> dict[str, float]:
    """Median seconds of one call of each case, where `case(count)` makes so many."""
    found = interleaved({name: lambda case=case: case(count) for name, case in cases.items()}, rounds)
    return {name: seconds / count for name, seconds in found.items()}
