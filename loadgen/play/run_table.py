"""The table that a run prints at its end: the most important figures of each robot.

All figures of the run are in its summary; `outcome_figures` computes them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.table.table_columns import ColumnSettings
from offboard.loadgen.table.table_formats import Heading, Table


@dataclass(frozen=True, slots=True)
class RobotLine:
    """The figures of one robot; None: undefined."""

    robot: str
    tasks: int
    lost: float | None
    failed: float | None
    mean_ms: float | None = None
    p95_ms: float | None = None
    p99_ms: float | None = None
    cloud_percent: float | None = None
    twice_percent: float | None = None
    late_percent: float | None = None
    empty_percent: float | None = None
    age_ms: float | None = None
    seam: float | None = None
    note: str = ""


HEADINGS: Mapping[str, Heading] = {
    "robot": Heading("robot", "robot", None),
    "tasks": Heading("tasks", "tasks", 0),
    "lost": Heading("lost", "lost", 0),
    "failed": Heading("failed", "failed", 0),
    "mean_ms": Heading("mean ms", "mean ms", 1),
    "p95_ms": Heading("P95 ms", "P95 ms", 1),
    "p99_ms": Heading("P99 ms", "P99 ms", 1),
    "late_percent": Heading("late %", r"late \%", 1),
    "cloud_percent": Heading("to cloud %", r"to cloud \%", 1),
    "twice_percent": Heading("on both %", r"on both \%", 1),
}
OF_STREAMS: Mapping[str, Heading] = {
    **{name: HEADINGS[name] for name in ("robot", "tasks", "lost", "failed")},
    "empty_percent": Heading("empty %", r"empty \%", 2),
    "age_ms": Heading("age ms", "age ms", 0),
    "seam": Heading("seam", "seam", 3),
}


def run_table(name: str, outcome: Outcome) -> str:
    """One line for each robot of the run; `late` is undefined without a deadline."""
    streams = any(one.step is not None for one in outcome.answered)
    headings = OF_STREAMS if streams else HEADINGS
    lines = [_line(robot, outcome.of([robot]), headings) for robot in outcome.asked]
    about = "steps of a stream" if streams else "from when each task was due to its answer"
    table = Table(f"{name}, {about}:", {"scenario": name}, headings, lines)
    return ColumnSettings().text([table])


def _line(robot: str, outcome: Outcome, headings: Mapping[str, Heading]) -> RobotLine:
    shown = headings.keys() & FIGURES.keys()
    if outcome.deadline_s is None:
        shown -= {"late_percent"}
    figures: dict[str, Any] = {name: FIGURES[name].compute(outcome) for name in shown}
    return RobotLine(robot, outcome.asked[robot], **figures)
