"""The figures of the applications: a line for each scenario and policy, the oracle, and every single task.

`applications` plays the runs, and `application_pictures` draws them.
"""

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from offboard.loadgen.replay.replay import ORACLE
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.table.confidence_intervals import Blocks, Picks
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import UNDEFINED
from offboard.loadgen.table.table_two_figures import quantile
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

DEFAULT = "default"
CONSTANTS = (ONBOARD, CLOUD)  # the policies that always choose the same site
POLICIES = (DEFAULT, *CONSTANTS, "paper")
WORST = 10  # tasks that are listed
COLUMNS = (
    "scenario",
    "policy",
    "mean ms",
    "P95 ms",
    "sent to cloud %",
    "own overhead ms",
    "own overhead %",
    "mean / better constant policy",
)
TASK_COLUMNS = (
    *("scenario", "seed", "i", "size", "work"),
    *(f"{policy}_ms" for policy in (*CONSTANTS, "paper", DEFAULT)),
    *(f"{DEFAULT}_{what}" for what in ("site", "reason", "predicts_onboard_ms", "predicts_cloud_ms")),
)


@dataclass(frozen=True, slots=True)
class Known:
    """What the files of a run know of one task; None: unknown. `site` is None if all sites were chosen.

    `work` is what the answer told, `predicted_s` what was predicted by site.
    """

    size: float
    work: float | None
    site: str | None
    reason: str
    predicted_s: Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class Run:
    """A run of one scenario with one seed and one policy; `known` is by the number of the task."""

    scenario: str
    seed: int
    policy: str
    outcome: Outcome
    known: Mapping[int, Known]

    @property
    def tasks(self) -> int:
        return max(self.outcome.asked.values())

    def times_ms(self) -> Column:
        """The response time of each task; NaN if it was never answered."""
        times = np.full(self.tasks, np.nan)
        for one in self.outcome.answered:
            times[one.i] = 1e3 * one.response_s
        return times


@dataclass(frozen=True, slots=True)
class Value:
    """A figure with its 95 % interval; None: no interval, because there are too few tasks."""

    value: float
    interval: tuple[float, float] | None = None

    def text(self, digits: int, *, interval: bool) -> str:
        if self.interval is None or not interval:
            return f"{self.value:.{digits}f}"
        low, high = self.interval
        return f"{self.value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@dataclass(frozen=True, slots=True)
class Line:
    """The figures of one policy in one scenario; None: undefined.

    `over_constant` is the mean over that of the better constant policy.
    """

    scenario: str
    policy: str
    mean_ms: Value
    p95_ms: float
    cloud_percent: float | None
    overhead_ms: float | None
    overhead_percent: float | None
    over_constant: Value

    def cells(self, *, intervals: bool) -> list[str]:
        return [
            self.scenario,
            self.policy,
            self.mean_ms.text(1, interval=intervals),
            f"{self.p95_ms:.1f}",
            _text(self.cloud_percent, 0),
            _text(self.overhead_ms, 2),
            _text(self.overhead_percent, 2),
            self.over_constant.text(2, interval=intervals),
        ]


def table(runs: Sequence[Run]) -> str:
    """A Markdown table with the lines of every scenario; with intervals if there is more than one seed."""
    intervals = len({run.seed for run in runs}) > 1
    rows = [COLUMNS, ["---"] * len(COLUMNS)]
    for scenario in dict.fromkeys(run.scenario for run in runs):
        rows += [line.cells(intervals=intervals) for line in lines(_of(runs, scenario))]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def in_words(runs: Sequence[Run]) -> list[str]:
    """How `default` compares with the better constant policy: a sentence for each scenario."""
    said = []
    for scenario in dict.fromkeys(run.scenario for run in runs):
        of = {line.policy: line for line in lines(_of(runs, scenario))}
        better = min(CONSTANTS, key=lambda policy: of[policy].mean_ms.value)
        ratio = of[DEFAULT].over_constant.text(2, interval=True)
        said.append(f"{scenario}: {DEFAULT} took {ratio} of the time of the better constant ({better}).")
    return said


def lines(runs: Sequence[Run]) -> list[Line]:
    """The lines of one scenario: one for each policy, and the oracle."""
    times = response_times(runs)
    constant = times[min(CONSTANTS, key=lambda policy: np.nanmean(times[policy]))]
    found = []
    for policy, times_ms in times.items():
        figures = _figures(times_ms, constant)
        whole = figures(np.arange(len(times_ms))[None])
        low, high = Blocks(len(times_ms)).intervals(figures)
        values = {
            name: Value(float(value[0]), (low[name], high[name]) if low else None)
            for name, value in whole.items()
        }
        answered = [one for run in runs if run.policy == policy for one in run.outcome.answered]
        own = {
            name: FIGURES[name].compute(Outcome({}, answered))
            for name in ("cloud_percent", "overhead_ms", "overhead_percent")
        }
        if policy == ORACLE:
            own["cloud_percent"] = 100 * float(np.mean(times[CLOUD] < times[ONBOARD]))
        p95_ms = float(quantile(times_ms[np.isfinite(times_ms)], 95))
        found.append(Line(runs[0].scenario, policy, p95_ms=p95_ms, **values, **own))
    return found


def response_times(runs: Sequence[Run]) -> dict[str, Column]:
    """The response times in ms of each policy and of the oracle: the tasks of all seeds in the same order.

    The oracle of a task is the smaller time of the two constant policies.
    """
    times = {
        policy: np.concatenate([run.times_ms() for run in runs if run.policy == policy])
        for policy in POLICIES
    }
    return {**times, ORACLE: np.fmin(*(times[policy] for policy in CONSTANTS))}


def tasks_csv(runs: Sequence[Run]) -> str:
    """One line for each task of each scenario and seed, with its times under every policy."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(TASK_COLUMNS)
    for by_policy in _together(runs):
        default = by_policy[DEFAULT]
        times = [by_policy[policy].times_ms() for policy in (*CONSTANTS, "paper", DEFAULT)]
        for i in range(default.tasks):
            known = default.known.get(i)
            predicted = {} if known is None else known.predicted_s
            writer.writerow(
                [
                    *(default.scenario, default.seed, i),
                    *((known.size, known.work) if known else ("", "")),
                    *(_text(time_ms[i], 3) for time_ms in times),
                    *((known.site or "both", known.reason) if known else ("", "")),
                    *(_in_ms(predicted.get(site)) for site in CONSTANTS),
                ]
            )
    return text.getvalue()


def worst_tasks(runs: Sequence[Run]) -> list[str]:
    """The tasks in which `default` lost most against the faster of the two constant runs, worst first."""
    found: list[tuple[float, str]] = []
    for by_policy in _together(runs):
        default = by_policy[DEFAULT]
        mine, *constant = (by_policy[policy].times_ms() for policy in (DEFAULT, *CONSTANTS))
        for i, known in default.known.items():
            lost_ms = mine[i] - np.fmin(constant[0][i], constant[1][i])
            if lost_ms > 0:
                times = ", ".join(
                    f"{site} {_text(time_ms[i], 0)}"
                    for site, time_ms in zip(CONSTANTS, constant, strict=True)
                )
                where = f"{default.scenario}, seed {default.seed}, task {i}: lost {lost_ms:.0f} ms"
                why = f"chose {known.site or 'both'}: {known.reason}"
                found.append((lost_ms, f"{where} ({DEFAULT} {mine[i]:.0f}, {times}); {why}"))
    return [text for _, text in sorted(found, reverse=True)[:WORST]]


def faults(runs: Sequence[Run]) -> dict[str, list[str]]:
    """The tasks without a verified answer, by what is wrong with them."""
    found: dict[str, list[str]] = {"lost": [], "failed": [], "wrong": [], "unverified": []}
    for run in runs:
        where = f"{run.scenario}, seed {run.seed}, policy {run.policy}, task"
        answered = {one.i for one in run.outcome.answered}
        found["lost"] += [f"{where} {i}: lost" for i in range(run.tasks) if i not in answered]
        for one in run.outcome.answered:
            for what, why in (("failed", one.error), ("wrong", one.wrong), ("unverified", one.unverified)):
                if why is not None:
                    found[what].append(f"{where} {one.i}: {what}: {why}")
    return found


def _figures(times_ms: Column, constant_ms: Column) -> Callable[[Picks], dict[str, Column]]:
    def figures(picks: Picks) -> dict[str, Column]:
        mean_ms = np.nanmean(times_ms[picks], axis=-1)
        return {"mean_ms": mean_ms, "over_constant": mean_ms / np.nanmean(constant_ms[picks], axis=-1)}

    return figures


def _of(runs: Sequence[Run], scenario: str) -> list[Run]:
    return [run for run in runs if run.scenario == scenario]


def _together(runs: Sequence[Run]) -> Iterator[dict[str, Run]]:
    """The runs of the same scenario and seed, by policy."""
    for scenario, seed in dict.fromkeys((run.scenario, run.seed) for run in runs):
        yield {run.policy: run for run in _of(runs, scenario) if run.seed == seed}


def _in_ms(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.3f}"


def _text(value: float | None, digits: int) -> str:
    return UNDEFINED if value is None or np.isnan(value) else f"{value:.{digits}f}"
