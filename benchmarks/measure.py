"""How benchmarks measure: medians of interleaved cases, tables, and requirements that figures must meet."""

import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROUNDS = 15


@dataclass(frozen=True, slots=True)
class Requirement:
    """A figure that must be at most `limit`, or at least `limit`."""

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
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.what}: {self.value:.3g}{unit}, {side} {self.limit:g}{unit}: {verdict}"


@dataclass(frozen=True, slots=True)
class Table:
    """A table as it is printed, its requirements, and the reasons why some cases were not measured."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    requirements: Sequence[Requirement] = ()
    missing: Sequence[str] = ()

    def __str__(self) -> str:
        lines = [f"## {self.title}", "", f"| {' | '.join(self.columns)} |"]
        lines.append("| " + " | ".join("---" for _ in self.columns) + " |")
        lines += [f"| {' | '.join(row)} |" for row in self.rows]
        lines += [
            "",
            *(f"- {requirement}" for requirement in self.requirements),
            *(f"- not measured: {reason}" for reason in self.missing),
        ]
        return "\n".join(lines).rstrip() + "\n"


def interleaved(cases: Mapping[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """The median seconds of each case.

    Each round runs all cases once, every other round in reverse order. One round before them is not counted.
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
    """The median seconds of one call of each case; `case(count)` makes `count` calls."""
    found = interleaved({name: lambda case=case: case(count) for name, case in cases.items()}, rounds)
    return {name: seconds / count for name, seconds in found.items()}


def processor() -> str:
    """The model of the CPU, or its architecture if the model is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()
