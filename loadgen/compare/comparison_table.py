"""The table of a comparison: one line of figures for each policy, with 95 % intervals.

`compare` plays or simulates the runs; `comparison_line` puts the result into one sentence.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from offboard.loadgen.compare.compare_settings import CONSTANTS, CompareConfig
from offboard.loadgen.compare.comparison_line import BY_COST, COST, FIRST, HEADINGS, Line, in_words
from offboard.loadgen.progress import progress
from offboard.loadgen.scenario.interval_coverage import interval_columns, interval_figures
from offboard.loadgen.scenario.outcome import Answered, Costing, Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.site_shares import median_recovery
from offboard.loadgen.table.confidence_intervals import BOUNDS, Blocks, Picks, percentiles
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import Table
from offboard.loadgen.table.table_two_figures import divided, known_mean, plain, quantile
from offboard.robot_client.policies.objectives import MEAN
from offboard.robot_client.sites.runner import CLOUD

SLOPES = (0.0, 1.0)  # a machine that is twice as slow makes no task faster, and none more than twice as long


def comparison_table(
    scenario: Scenario,
    config: CompareConfig,
    runs: Mapping[str, Sequence[Outcome]],
    each: Callable[..., Iterable[list[Line]]] = map,
) -> Table:
    """One line for each policy, with the ends of its 95 % interval below it, and one sentence at the end.

    `each` is `map`, or a replacement that uses several processes.
    """
    names, costing = config.policies, scenario.costing
    constant = _better_constant(runs, costing)
    divisor = runs[constant] if constant else ()
    lines: list[Line] = []
    with progress("bootstrap", len(names)) as shown:
        judged = [runs[name] for name in names], [divisor for _ in names], [costing for _ in names]
        for found in each(_lines, names, *judged):
            lines.extend(found)
            shown.step()
    span = f", counted from task {config.from_task} on" if config.from_task else ""
    caption = (
        f"Scenario {scenario.name} {config.place}: {_runs_and_seeds(scenario.seed, config.seeds)},"
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
    measured = counts | plain({name: value[0] for name, value in measured.items()})
    measured["recovery"], note = median_recovery(runs)
    ends = [Line(policy, name, **counts, **bound) for name, bound in zip(BOUNDS, bounds, strict=True)]
    return [Line(policy, lost=lost, note=note, **measured), *ends]


def _columns(runs: Sequence[Outcome], constant: Sequence[Outcome], costing: Costing) -> dict[str, Column]:
    """Columns with one value for each task; NaN where a task has no value.

    `constant`: the same runs of the better constant; empty if there is none.
    """
    mine: list[Answered] = []
    theirs: list[Answered | None] = []  # None: the better constant did not answer this task
    late: list[float | None] = []
    for run, other in itertools.zip_longest(runs, constant):
        answered = {(one.robot, one.i): one for one in other.answered} if other else {}
        for one in sorted(run.answered, key=lambda one: (one.robot, one.i)):
            mine.append(one)
            theirs.append(answered.get((one.robot, one.i)))
            late.append(None if run.deadline_s is None else float(one.response_s > run.deadline_s))

    def column(tasks: Iterable[Answered | None], value: Callable[[Answered], float | None]) -> Column:
        return np.array([None if one is None else value(one) for one in tasks], dtype=float)

    return {
        "response_s": column(mine, lambda one: one.response_s),
        "constant_s": column(theirs, lambda one: one.response_s),
        "server_s": column(mine, lambda one: one.server_s),
        "constant_server_s": column(theirs, lambda one: one.server_s),
        "cost": column(mine, lambda one: one.cost(costing)),
        "constant_cost": column(theirs, lambda one: one.cost(costing)),
        "quality": column(mine, lambda one: one.quality),
        "late": np.array(late, dtype=float),
        "cloud": column(mine, _sent_to_cloud),
        "twice": column(mine, lambda one: len(one.sites) > 1),
        **interval_columns([one.intervals for one in mine]),
    }


def _sent_to_cloud(one: Answered) -> float | None:
    """1 if the policy sent the task to the cloud, 0 if not; None if it chose both sites or is unknown."""
    return None if one.both or not one.chosen else float(one.chosen == CLOUD)


def _referenced(runs: Sequence[Outcome]) -> dict[str, Column]:
    references = [one for run in runs for one in run.references]
    return {
        "sent_s": np.array([one.sent_s for one in references]),
        "oracle_s": np.array([one.oracle_s for one in references]),
    }


# Figures for each resample, which is one row of `picks`.
def _task_figures(columns: Mapping[str, Column], picks: Picks, costing: Costing) -> dict[str, Column]:
    cost, constant_cost = columns["cost"][picks], columns["constant_cost"][picks]
    shared = np.where(np.isnan(constant_cost), np.nan, cost)
    response, constant = columns["response_s"][picks], columns["constant_s"][picks]
    server, constant_server = columns["server_s"][picks], columns["constant_server_s"][picks]
    return {
        "mean_ms": 1e3 * response.mean(axis=-1),
        "over_constant": _ratio(response, constant),
        "server_over_constant": _ratio(server, constant_server),
        "cost": costing.over(cost),
        "cost_over_constant": divided(costing.over(shared), costing.over(constant_cost)),
        "quality": known_mean(columns["quality"][picks]),
        "p95_ms": 1e3 * quantile(response, 95),
        "p99_ms": 1e3 * quantile(response, 99),
        "late_percent": 100 * known_mean(columns["late"][picks]),
        "cloud_percent": 100 * known_mean(columns["cloud"][picks]),
        "twice_percent": 100 * known_mean(columns["twice"][picks]),
        **interval_figures(columns, picks),
    }


def _reference_figures(columns: Mapping[str, Column], picks: Picks) -> dict[str, Column]:
    sent, oracle = columns["sent_s"][picks], columns["oracle_s"][picks]
    return {"time_over_oracle": _ratio(sent, oracle), "regret_ms": 1e3 * (sent - oracle).mean(axis=-1)}


def _ratio(over: Column, under: Column) -> Column:
    """The ratio of the sums of each row, over the tasks that both have; NaN if there are none."""
    both = ~(np.isnan(over) | np.isnan(under))
    upper, lower = np.where(both, over, 0.0).sum(axis=-1), np.where(both, under, 0.0).sum(axis=-1)
    return divided(upper, lower)


def speed_slope(resampled: Mapping[str, Column]) -> float:
    """The exponent with which `over_constant` follows `server_over_constant`; 0 if that never differs.

    The time that a planning server needs for a task does not depend on the policy of the robot that asks. If
    the server was slower in the runs of one policy, the machine was slower then. The ratio of mean times is
    corrected by how strongly the two ratios vary together over resamples of the tasks (control variates;
    Lavenberg and Welch 1981, "A perspective on the use of control variables to increase the efficiency of
    Monte Carlo simulations").
    """
    server, over = (np.log(resampled[name]) for name in ("server_over_constant", "over_constant"))
    known = np.isfinite(server) & np.isfinite(over)
    if not known.any() or not np.ptp(server[known]):
        return 0.0
    spread, together = np.cov(server[known], over[known])[0]
    return float(np.clip(together / spread, *SLOPES))


def at_one_speed(figures: Mapping[str, Column], slope: float) -> Column:
    """`over_constant` of each resample, as if the server had been equally fast in the runs of both policies.

    NaN if no task was sent to the cloud by both.
    """
    found: Column = figures["over_constant"] * np.exp(-slope * np.log(figures["server_over_constant"]))
    return found
