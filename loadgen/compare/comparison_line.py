"""One line of the table of a comparison, and its result in one sentence.

The figures are computed by `comparison_table`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from offboard.common.config import REQUIRED
from offboard.loadgen.compare.compare_settings import CONSTANTS
from offboard.loadgen.table.table_formats import column, headings_of
from offboard.robot_client import policies

MISSING = f"Nothing is divided: name {' and '.join(CONSTANTS)} among --policies to compare with them."


@dataclass(frozen=True, slots=True)
class Line:
    """The figures of one policy over the tasks of all its runs; None: undefined.

    - `cost`: what the scenario's objective makes small, per task; `quality`: of the variants that answered
    - `cost_over_constant`, `over_constant`: cost and mean time, over those of the better one of the policies
      `onboard` and `cloud`, on the same tasks; the better one has the lower cost
    - `server_over_constant`: the same for the server's own run time, on tasks that both sent to the cloud
    - `at_one_speed`: `over_constant` without the difference in machine speed (`speed_slope`)
    - `recovery`: number of tasks until recovery from an outage
    - `coverage_percent`, `relative_width`, `width_over_constant`: of the prediction intervals
    - `time_over_oracle`, `regret_ms`: over the `referenced` tasks, which also ran on each site alone
    """

    policy: str = column("policy", default=REQUIRED)
    bound: str = column("bound", default="")
    tasks: int = column("tasks", 0, default=0)
    lost: int | None = column("lost", 0)
    mean_ms: float | None = column("mean ms", 1)
    over_constant: float | None = column("mean / better constant", 3)
    at_one_speed: float | None = column(
        "mean / better constant at equal machine speed", 3, latex="at equal speed"
    )
    server_over_constant: float | None = column("server time / better constant", 3)
    cost: float | None = column("cost", 4)
    cost_over_constant: float | None = column("cost / better constant", 3)
    quality: float | None = column("quality", 3)
    p95_ms: float | None = column("P95 ms", 1)
    p99_ms: float | None = column("P99 ms", 1)
    late_percent: float | None = column("late %", 2)
    cloud_percent: float | None = column("sent to cloud %", 1, latex=r"to cloud \%")
    twice_percent: float | None = column("ran on both sites %", 1, latex=r"on both sites \%")
    recovery: float | None = column("recovery tasks", 1)
    coverage_percent: float | None = column("times within interval %", 1, latex=r"within interval \%")
    relative_width: float | None = column("interval width / prediction", 2, latex="width / prediction")
    width_over_constant: float | None = column(
        "interval width / best constant width", 2, latex="width / constant"
    )
    referenced: int = column("reference tasks", 0, default=0)
    time_over_oracle: float | None = column("time / oracle", 3)
    regret_ms: float | None = column("regret ms", 1)
    note: str = ""


HEADINGS = headings_of(Line)
FIRST = (  # the most important columns
    *("tasks", "lost", "mean_ms", "over_constant", "p95_ms", "p99_ms"),
    *("late_percent", "cloud_percent", "time_over_oracle", "recovery"),
)

COST = ("cost", "cost_over_constant", "quality")
BY_COST = (  # if a scenario has an objective or variants: its cost comes first, and mean times judge nothing
    *("tasks", "lost", "mean_ms", "p95_ms"),
    *("late_percent", "cloud_percent", "twice_percent"),
)


def in_words(lines: Sequence[Line], constant: str | None, *, by_cost: bool) -> str:
    """The sentence about `default`, or about the first policy that is no constant.

    `constant` is the better constant policy; None if the two constants were not both played.
    """
    of = {line.policy: line for line in lines}
    others = [name for name in of if name not in CONSTANTS]
    if constant is None:
        return MISSING
    if not others:
        return f"{constant} is the better constant."
    name = next((one for one in others if policies.full_name(one) == policies.DEFAULT), others[0])
    said = [f"{name}: {_ratio(of[name], of[constant], by_cost=by_cost)}", *_faults(of[name])]
    return "; ".join([", ".join(said), *_of_constants([of[one] for one in CONSTANTS])]) + "."


def _ratio(line: Line, constant: Line, *, by_cost: bool) -> str:
    ratio = line.cost_over_constant if by_cost else line.over_constant
    if ratio is not None:
        what = "cost" if by_cost else "mean time"
        return f"{ratio:.2f} of the better constant ({constant.policy}) in {what}"
    if line.cost is None or constant.cost is None:
        return f"no task in common with the better constant ({constant.policy})"
    return f"a cost of {line.cost:.4f}, and {constant.cost:.4f} of the better constant ({constant.policy})"


def _faults(line: Line) -> list[str]:
    """Its late and lost tasks, and its quality, where they are known."""
    said = []
    if line.late_percent is not None:
        said.append(f"late in {line.late_percent:.3g} %" if line.late_percent else "no task late")
    if line.lost:
        said.append(f"{line.lost} tasks lost")
    if line.quality is not None:
        said.append(f"quality {line.quality:.2f}")
    return said


def _of_constants(lines: Sequence[Line]) -> list[str]:
    """How late each constant policy was, if it was, and the quality of its answers."""
    said = [f"{one.policy} alone was late in {one.late_percent:.3g} %" for one in lines if one.late_percent]
    known = [f"{one.policy} alone {one.quality:.2f}" for one in lines if one.quality is not None]
    return [" and ".join(said)] * bool(said) + [f"quality of {' and of '.join(known)}"] * bool(known)
