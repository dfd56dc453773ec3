"""The table that a run prints at its end: the most important figures of each robot.

All figures of the run are in its summary; `outcome_figures` computes them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.table.table_columns import MARKDOWN, ColumnSettings
from offboard.loadgen.table.table_formats import Heading, Table


@dataclass(frozen=True, slots=True)
class RobotLine:
    """The figures of one robot; None: undefined."""

    robot: str
    tasks: int
    lost: float | None
    failed: float | None
    mean_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    late_percent: float | None
    cloud_percent: float | None
    twice_percent: float | None
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


def run_table(name: str, outcome: Outcome) -> str:
    """One line for each robot of the run; `late` is undefined without a deadline."""
    lines = [_line(robot, _of(robot, outcome)) for robot in outcome.asked]
    table = Table(f"{name}, from when each task was due to its answer:", {"scenario": name}, HEADINGS, lines)
    return ColumnSettings().text([table], MARKDOWN)


def _of(robot: str, outcome: Outcome) -> Outcome:
    answered = [one for one in outcome.answered if one.robot == robot]
    return replace(outcome, asked={robot: outcome.asked[robot]}, answered=answered)


def _line(robot: str, outcome: Outcome) -> RobotLine:
    def figure(name: str) -> float | None:
        return FIGURES[name].compute(outcome)

    return RobotLine(
        robot,
        tasks=outcome.asked[robot],
        lost=figure("lost"),
        failed=figure("failed"),
        mean_ms=figure("mean_ms"),
        p95_ms=figure("p95_ms"),
        p99_ms=figure("p99_ms"),
        late_percent=None if outcome.deadline_s is None else figure("late_percent"),
        cloud_percent=figure("cloud_percent"),
        twice_percent=figure("twice_percent"),
    )
