"""The table of a comparison: one line of figures for each policy, with 95 % intervals.

It starts from the outcomes of the runs; `compare` plays them, `simulated_tables` simulates them.
The sentence below the table is in `comparison_in_words`.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from offboard.loadgen.compare.compare_settings import CONSTANTS, SIMULATION, CompareConfig
from offboard.loadgen.compare.comparison_in_words import in_words
from offboard.loadgen.compare.machine_speed import at_one_speed, speed_slope
from offboard.loadgen.progress import progress
from offboard.loadgen.scenario.interval_coverage import interval_columns, interval_figures
from offboard.loadgen.scenario.outage_recovery import median_recovery
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.task_cost import Costing
from offboard.loadgen.table.confidence_intervals import BOUNDS, Blocks, Picks, percentiles
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import Heading, Table
from offboard.loadgen.table.table_two_figures import known_mean, quantile
from offboard.robot_client.policies.objectives import MEAN
from offboard.robot_client.sites.runner import CLOUD


@dataclass(frozen=True, slots=True)
class Line:
    """The figures of one policy over the tasks of all its runs; None: undefined.

    - `cost`: what the scenario's objective makes small, per task; `quality`: of the variants that answered
    - `cost_over_constant`, `over_constant`: cost and mean time, over those of the better one of the policies
      `onboard` and `cloud`, on the same tasks; the better one has the lower cost
    - `server_over_constant`: the same for the server's own run time, on tasks that both sent to the cloud
    - `at_one_speed`: `over_constant` without the difference in machine speed (`machine_speed`)
    - `recovery`: number of tasks until recovery from an outage
    - `coverage_percent`, `relative_width`, `width_over_constant`: of the prediction intervals
    - `time_over_oracle`, `regret_ms`: over the `referenced` tasks, which also ran on each site alone
    """

    policy: str
    bound: str = ""
    tasks: int = 0
    lost: int | None = None
    mean_ms: float | None = None
    over_constant: float | None = None
    at_one_speed: float | None = None
    server_over_constant: float | None = None
    cost: float | None = None
    cost_over_constant: float | None = None
    quality: float | None = None
    p95_ms: float | None = None
    p99_ms: float | None = None
    late_percent: float | None = None
    cloud_percent: float | None = None
    twice_percent: float | None = None
    recovery: float | None = None
    coverage_percent: float | None = None
    relative_width: float | None = None
    width_over_constant: float | None = None
    referenced: int = 0
    time_over_oracle: float | None = None
    regret_ms: float | None = None
    note: str = ""


HEADINGS: dict[str, Heading] = {
    "policy": Heading("policy", "policy", None),
    "bound": Heading("bound", "bound", None),
    "tasks": Heading("tasks", "tasks", 0),
    "lost": Heading("lost", "lost", 0),
    "mean_ms": Heading("mean ms", "mean ms", 1),
    "over_constant": Heading("mean / better constant", "mean / better constant", 3),
    "at_one_speed": Heading("mean / better constant at equal machine speed", "at equal speed", 3),
    "server_over_constant": Heading("server time / better constant", "server time / better constant", 3),
    "cost": Heading("cost", "cost", 4),
    "cost_over_constant": Heading("cost / better constant", "cost / better constant", 3),
    "quality": Heading("quality", "quality", 3),
    "p95_ms": Heading("P95 ms", "P95 ms", 1),
    "p99_ms": Heading("P99 ms", "P99 ms", 1),
    "late_percent": Heading("late %", r"late \%", 2),
    "cloud_percent": Heading("sent to cloud %", r"to cloud \%", 1),
    "twice_percent": Heading("ran on both sites %", r"on both sites \%", 1),
    "recovery": Heading("recovery tasks", "recovery tasks", 1),
    "coverage_percent": Heading("times within interval %", r"within interval \%", 1),
    "relative_width": Heading("interval width / prediction", "width / prediction", 2),
    "width_over_constant": Heading("interval width / best constant width", "width / constant", 2),
    "referenced": Heading("reference tasks", "reference tasks", 0),
    "time_over_oracle": Heading("time / oracle", "time / oracle", 3),
    "regret_ms": Heading("regret ms", "regret ms", 1),
}
FIRST = (  # the most important columns
    *("tasks", "lost", "mean_ms", "over_constant", "p95_ms", "p99_ms"),
    *("late_percent", "cloud_percent", "time_over_oracle", "recovery"),
)

COST = ("cost", "cost_over_constant", "quality")
BY_COST = (  # if a scenario has an objective or variants: its cost comes first, and mean times judge nothing
    *("tasks", "lost", "mean_ms", "p95_ms"),
    *("late_percent", "cloud_percent", "twice_percent"),
)


def comparison_table(
    scenario: Scenario,
    config: CompareConfig,
    runs: Mapping[str, Sequence[Outcome]],
    each: Callable[..., Iterable[list[Line]]] = map,
) -> Table:
    """One line for each policy, with the ends of its 95 % interval below it, and one sentence at the end.

    `each` is `map`, or a replacement that uses several processes.
    """
    names, costing = config.policies, scenario.costing()
    constant = _better_constant(runs, costing)
    divisor = runs[constant] if constant else ()
    lines: list[Line] = []
    with progress("bootstrap", len(names)) as shown:
        judged = [runs[name] for name in names], [divisor for _ in names], [costing for _ in names]
        for found in each(_lines, names, *judged):
            lines.extend(found)
            shown.step()
    span = f", counted from task {config.from_task} on" if config.from_task else ""
    place = f"in {SIMULATION}" if config.simulate else f"on the {config.testbed} testbed"
    caption = (
        f"Scenario {scenario.name} {place}: {_runs_and_seeds(scenario.seed, config.seeds)},"
        f" {scenario.workload.tasks} tasks for each robot{span}."
        " Below each policy are the bounds of its 95 % intervals, from blocks of neighbouring tasks."
        f" {scenario.recorded_text()}"
    ).rstrip()
    about = {"scenario": scenario.name, "testbed": config.where, "seeds": config.seeds}
    varied = any(line.quality is not None for line in lines)
    by_cost = varied or scenario.robot.objective != MEAN
    leading = [name for name in COST if varied or name != "quality"] if by_cost else []
    return Table(
        caption=caption,
        about=about,
        headings={name: HEADINGS[name] for name in dict.fromkeys(("policy", "bound", *leading, *HEADINGS))},
        lines=lines,
        first=(*leading, *(BY_COST if by_cost else FIRST)),
        ending=in_words([line for line in lines if not line.bound], constant, by_cost=by_cost),
    )


def _better_constant(runs: Mapping[str, Sequence[Outcome]], costing: Costing) -> str | None:
    """The constant policy with the lower cost over all its tasks; None unless both were played."""
    costs = {}
    for name in CONSTANTS:
        paid = [one.cost(costing) for run in runs.get(name, ()) for one in run.answered]
        if not paid:
            return None
        costs[name] = float(costing.over(np.array(paid)))
    return min(costs, key=costs.__getitem__)


def _runs_and_seeds(first: int, count: int) -> str:
    if count == 1:
        return f"1 run of each policy with seed {first}"
    return f"{count} runs of each policy with seeds {first} to {first + count - 1}"


def _lines(policy: str, runs: Sequence[Outcome], constant: Sequence[Outcome], costing: Costing) -> list[Line]:
    """The figures of a policy, then the low and the high ends of their intervals."""
    asked = sum(sum(run.asked.values()) for run in runs)
    columns, referenced = _columns(runs, constant, costing), _referenced(runs)
    count = len(columns["response_s"])
    lost = asked - count
    counts: dict[str, Any] = {"tasks": count, "referenced": len(referenced["sent_s"])}
    if not count:
        return [Line(policy, lost=lost, **counts)]
    one = np.arange(count)[None]
    measured: dict[str, Any] = _task_figures(columns, one, costing)
    own = np.arange(counts["referenced"])[None]
    measured |= _reference_figures(referenced, own) if counts["referenced"] else {}
    resampled = Blocks(count).resampled(lambda picks: _task_figures(columns, picks, costing))
    if resampled:
        slope = speed_slope(resampled)
        for figures in (measured, resampled):
            figures["at_one_speed"] = at_one_speed(figures, slope)
    bounds = percentiles(resampled)
    if counts["referenced"]:
        more = Blocks(counts["referenced"]).intervals(lambda picks: _reference_figures(referenced, picks))
        bounds = tuple({**bound, **other} for bound, other in zip(bounds, more, strict=True))
    measured = counts | {name: _plain(value[0]) for name, value in measured.items()}
    measured["recovery"], note = median_recovery(runs)
    ends = [Line(policy, name, **counts, **bound) for name, bound in zip(BOUNDS, bounds, strict=True)]
    return [Line(policy, lost=lost, note=note, **measured), *ends]


@dataclass(frozen=True, slots=True)
class _Pair:
    """One task of a policy, the same task of the better constant if answered there, and the deadline."""

    mine: Answered
    constant: Answered | None
    deadline_s: float | None


def _pairs(runs: Sequence[Outcome], constant: Sequence[Outcome]) -> list[_Pair]:
    """`constant` is empty if there is no better constant."""
    found = []
    for run, other in itertools.zip_longest(runs, constant):
        theirs = {(one.robot, one.i): one for one in other.answered} if other else {}
        for one in sorted(run.answered, key=lambda one: (one.robot, one.i)):
            found.append(_Pair(one, theirs.get((one.robot, one.i)), run.deadline_s))
    return found


def _columns(runs: Sequence[Outcome], constant: Sequence[Outcome], costing: Costing) -> dict[str, Column]:
    """Columns with one value for each task; NaN where a task has no value."""

    def column(value: Callable[[_Pair], float | None]) -> Column:
        return np.array([value(pair) for pair in pairs], dtype=float)

    pairs = _pairs(runs, constant)
    return {
        "response_s": column(lambda pair: pair.mine.response_s),
        "constant_s": column(lambda pair: pair.constant.response_s if pair.constant else None),
        "server_s": column(lambda pair: pair.mine.server_s),
        "constant_server_s": column(lambda pair: pair.constant.server_s if pair.constant else None),
        "cost": column(lambda pair: pair.mine.cost(costing)),
        "constant_cost": column(lambda pair: pair.constant.cost(costing) if pair.constant else None),
        "quality": column(lambda pair: pair.mine.quality),
        "late": column(_late),
        "cloud": column(_sent_to_cloud),
        "twice": column(lambda pair: len(pair.mine.sites) > 1),
        **interval_columns([pair.mine.intervals for pair in pairs]),
    }


def _late(pair: _Pair) -> float | None:
    return None if pair.deadline_s is None else float(pair.mine.response_s > pair.deadline_s)


def _sent_to_cloud(pair: _Pair) -> float | None:
    """1 if the policy sent the task to the cloud, 0 if not; None if it chose both sites or is unknown."""
    mine = pair.mine
    return None if mine.both or not mine.chosen else float(mine.chosen == CLOUD)


def _referenced(runs: Sequence[Outcome]) -> dict[str, Column]:
    references = [one for run in runs for one in run.references]
    return {
        "sent_s": np.array([one.sent_s for one in references]),
        "oracle_s": np.array([one.oracle_s for one in references]),
    }


def _task_figures(columns: Mapping[str, Column], picks: Picks, costing: Costing) -> dict[str, Column]:
    """The figures over all tasks, for each resample (one row of `picks`)."""
    cost, constant_cost = columns["cost"][picks], columns["constant_cost"][picks]
    shared = np.where(np.isnan(constant_cost), np.nan, cost)
    response, constant = columns["response_s"][picks], columns["constant_s"][picks]
    server, constant_server = columns["server_s"][picks], columns["constant_server_s"][picks]
    return {
        "mean_ms": 1e3 * response.mean(axis=-1),
        "over_constant": _ratio(response, constant),
        "server_over_constant": _ratio(server, constant_server),
        "cost": costing.over(cost),
        "cost_over_constant": _over(costing.over(shared), costing.over(constant_cost)),
        "quality": known_mean(columns["quality"][picks]),
        "p95_ms": 1e3 * quantile(response, 95),
        "p99_ms": 1e3 * quantile(response, 99),
        "late_percent": 100 * known_mean(columns["late"][picks]),
        "cloud_percent": 100 * known_mean(columns["cloud"][picks]),
        "twice_percent": 100 * known_mean(columns["twice"][picks]),
        **interval_figures(columns, picks),
    }


def _reference_figures(columns: Mapping[str, Column], picks: Picks) -> dict[str, Column]:
    """The figures over the reference tasks, for each resample (one row of `picks`)."""
    sent, oracle = columns["sent_s"][picks], columns["oracle_s"][picks]
    return {
        "time_over_oracle": _ratio(sent, oracle),
        "regret_ms": 1e3 * (sent - oracle).mean(axis=-1),
    }


def _ratio(over: Column, under: Column) -> Column:
    """The ratio of the sums of each row, over the tasks that both have; NaN if there are none."""
    both = ~(np.isnan(over) | np.isnan(under))
    upper, lower = np.where(both, over, 0.0).sum(axis=-1), np.where(both, under, 0.0).sum(axis=-1)
    ratio: Column = np.divide(upper, lower, where=lower > 0, out=np.full(len(over), np.nan))
    return ratio


def _over(cost: Column, constant: Column) -> Column:
    """NaN where the better constant costs nothing, or answered none of these tasks."""
    ratio: Column = np.divide(cost, constant, where=constant > 0, out=np.full(len(cost), np.nan))
    return ratio


def _plain(value: Any) -> float | None:
    return None if np.isnan(value) else float(value)
