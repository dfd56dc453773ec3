"""`loadgen replay`: runs each policy on the same measured tasks, with the `Offloader` of the robot.

Only the runners differ from a live run: they answer at once, with the time that was measured.
"""

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.config import check, setting
from offboard.common.errors import DataError
from offboard.common.tasks import Kind, Task, task
from offboard.loadgen import rivals
from offboard.loadgen.progress import progress
from offboard.loadgen.table import confidence_intervals, table_two_figures
from offboard.loadgen.table.measured_rows import Column, Rows, read_lived
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.table_formats import Heading, Table
from offboard.loadgen.table.table_settings import BOTH, FULL, MeasuredTimesConfig
from offboard.loadgen.table.table_two_figures import Scored, Sides
from offboard.robot_client import policies
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Policy, Probe
from offboard.robot_client.predictors import Predictor
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX
from offboard.robot_client.sites.runner import (
    CLOUD,
    NOTHING,
    ONBOARD,
    UNMEASURED,
    Condition,
    Execution,
    Sending,
)

ORACLE = "oracle"
RECORDED = "as recorded"


@dataclass(frozen=True)
class ReplayConfig(MeasuredTimesConfig):
    """Which policies to replay, and with which predictor."""

    policies: tuple[str, ...] = setting(
        (*rivals.RULES, policies.DEFAULT), f"policies to replay: {rivals.POLICY_HELP}", metavar="NAME,NAME,.."
    )
    predictor: str | None = setting(
        None,
        f"predictor for all policies, instead of the one that each policy brings: {rivals.PREDICTOR_HELP}",
        metavar="NAME",
    )
    window: int = setting(
        WINDOW,
        "window length N; the first N rows are warm-up and are not scored",
        minimum=2,
        maximum=WINDOW_MAX,
    )

    def __post_init__(self) -> None:
        check(self)
        for policy in self.policies:
            rivals.policy(policy, "--policies")
        if self.predictor is not None:
            rivals.predictor(self.predictor, "--predictor")


@dataclass(frozen=True, slots=True)
class PolicyScore:
    """One line of the table: one policy on the `scored` tasks. None: undefined, or not known from the file.

    If a policy ran a task on both sites, its time is that of the first answer.
    """

    policy: str
    bound: str = ""
    scored: int = 0
    mean_s: float | None = None
    p95_s: float | None = None
    p99_s: float | None = None
    time_over_oracle: float | None = None
    regret_s: float | None = None
    regret_mean_s: float | None = None
    accuracy_percent: float | None = None
    cloud_percent: float | None = None
    both_percent: float | None = None
    note: str = ""


HEADINGS: dict[str, Heading] = {
    "policy": Heading("policy", "policy", None),
    "bound": Heading("bound", "bound", None),
    "scored": Heading("tasks", "tasks", 0),
    "mean_s": Heading("mean s", "mean", 5),
    "p95_s": Heading("P95 s", "P95", 5),
    "p99_s": Heading("P99 s", "P99", 5),
    "time_over_oracle": Heading("time/oracle", "time/oracle", 5),
    "regret_s": Heading("regret s", "regret", 5),
    "regret_mean_s": Heading("regret s/task", "regret/task", 5),
    "accuracy_percent": Heading("accuracy %", r"acc. \%", 2),
    "cloud_percent": Heading("cloud %", r"cloud \%", 2),
    "both_percent": Heading("on both sites %", r"on both sites \%", 2),
}
FIRST = ("scored", "mean_s", "p95_s", "time_over_oracle", "accuracy_percent", "cloud_percent")


@dataclass(frozen=True, slots=True)
class Replayed:
    """What a policy did with the scored rows: whether the cloud answered first, whether both sites ran."""

    to_cloud: Sides
    both: Sides


def run_replay(path: Path, config: ReplayConfig) -> int:
    """Print the tables of `path` to stdout."""
    config.check_columns(HEADINGS, config.format)
    sys.stdout.write(config.text(tables(path, config), config.format))
    return 0


def tables(path: Path, config: ReplayConfig) -> list[Table]:
    """One table for each feedback mode. The first line of a trace's table is the recorded run itself."""
    rows, lived = read_noted(path, config.kind, least=0), read_lived(path, config.kind)
    if not len(rows) + rows.left_out:
        raise DataError(f"{path}: there is no {config.kind or 'task'} in this trace")
    recorded = [_recorded(lived.waited_s, lived.to_cloud)] if len(lived.waited_s) else []
    with progress("policies", len(config.modes()) * (len(config.policies) + 1)) as shown:
        lines = {mode: [*recorded, *_mode_lines(rows, config, mode, shown.step)] for mode in config.modes()}
    return [_table(path, rows, config, lines[mode], feedback=mode) for mode in config.modes()]


def replay(
    rows: Rows, policy: str, *, predictor: str | None, window: int, feedback: str, seed: int = 1
) -> Replayed:
    """Replay the policy with this name; without a `predictor` it uses its own."""
    known = rivals.policy(policy)
    name = policies.predictor_of(known) if predictor is None else predictor
    return replay_policy(
        rows,
        policies.make(known, seed),
        predictor=lambda: rivals.make(name, window, seed),
        window=window,
        feedback=feedback,
    )


def replay_policy(
    rows: Rows, policy: Policy, *, predictor: Callable[[], Predictor], window: int, feedback: str
) -> Replayed:
    """Let `policy` decide every row, in order; its decisions on the rows after the first `window`.

    The warm-up runs on both sites for every policy, so that all policies are scored on the same rows.
    """
    chooser = _Chooser(policy, every=feedback == FULL)
    to_cloud, both = np.zeros((2, len(rows)), dtype=bool)
    with Offloader(
        [_Replaying(ONBOARD, rows.onboard_s), _Replaying(CLOUD, rows.cloud_s)],
        policy=chooser,
        memories=Memories(predictor),
    ) as offload:
        for row, size in enumerate(rows.size.tolist()):
            offload(_replayed, size, row, where=BOTH if row < window else None)
            if row >= window:
                to_cloud[row], both[row] = chooser.last.site == CLOUD, _ran_both(chooser.last)
    first = rows.cloud_s < rows.onboard_s
    return Replayed(np.where(both, first, to_cloud)[window:], both[window:])


def _ran_both(decision: Decision) -> bool:
    """A probe runs both at once; a hedge waits for a time that a replayed task does not have."""
    return decision.both or isinstance(decision.second, Probe)


class _Chooser:
    """Wraps a policy, and keeps its last decision.

    With `every`, each task runs on both sites, so that both learn.
    """

    last: Decision

    def __init__(self, policy: Policy, *, every: bool) -> None:
        self._policy = policy
        self._every = every

    def decide(self, forecast: Forecast) -> Decision:
        self.last = self._policy.decide(forecast)
        return self.last._replace(both=self.last.both or self._every)


class _Replaying:
    """A runner that returns the measured times."""

    def __init__(self, site: str, seconds: Column) -> None:
        self.site = site
        self._seconds = seconds.tolist()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - every row has both times
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - it was answered
        _, row = task.args
        future: Future[Execution] = Future()
        future.set_result(Execution(self.site, self._seconds[row]))
        return future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - nothing is sent
        return NOTHING

    def cancel(self, task: Task) -> None:
        pass

    def hurry(self) -> None:
        pass

    def condition(self) -> Condition:
        return UNMEASURED

    def close(self) -> None:
        pass


@task("replayed", size=lambda size, row: size)  # noqa: ARG005 - the size of a row is known
def _replayed(size: float, row: int) -> None:  # noqa: ARG001
    raise AssertionError("a replayed task is looked up, not run")


def _table(path: Path, rows: Rows, config: ReplayConfig, lines: list[PolicyScore], *, feedback: str) -> Table:
    left_out = f" ({rows.left_out} tasks without both times left out)" if rows.left_out else ""
    predictor = config.predictor or "each policy's own"
    about = f"predictor {predictor}, window {config.window}, feedback {feedback}"
    return Table(
        caption=f"{path}: {len(rows)} rows{left_out}, {about}.",
        about={
            "source": str(path),
            "rows": len(rows),
            "left_out": rows.left_out,
            "feedback": feedback,
            "predictor": predictor,
            "window": config.window,
        },
        headings={name: of for name, of in HEADINGS.items() if name != "bound" or config.bootstrap},
        lines=lines,
        notes=rows.notes,
        first=FIRST,
    )


def _mode_lines(
    rows: Rows, config: ReplayConfig, feedback: str, step: Callable[[], object]
) -> Iterator[PolicyScore]:
    """The lines of one feedback mode; `step` is called after each policy."""
    for name in (*config.policies, ORACLE):
        yield from _lines(rows, name, config, feedback)
        step()


def _lines(rows: Rows, policy: str, config: ReplayConfig, feedback: str) -> Iterator[PolicyScore]:
    """The figures of one policy, and with --bootstrap the ends of their intervals."""
    line = PolicyScore(policy)
    if len(rows) <= config.window:
        both = f"{len(rows) or 'no'} tasks ran on both sites, but the warm-up needs {config.window}"
        yield replace(line, note=f"cannot be replayed: {both}")
        return
    scored = rows.since(config.window)
    if policy == ORACLE:
        first = scored.cloud_s < scored.onboard_s
        played = Replayed(first, np.zeros_like(first))
    else:
        played = replay(
            rows,
            policy,
            predictor=config.predictor,
            window=config.window,
            feedback=feedback,
            seed=config.seed,
        )
    sent = Scored(scored.onboard_s, scored.cloud_s, played.to_cloud)
    yield replace(line, scored=len(scored), **table_two_figures.plain(_figures(sent, played.both)))
    if config.bootstrap:
        ends = config.blocks(len(scored)).intervals(
            lambda picks: _figures(sent.picked(picks), played.both[picks])
        )
        for bound, end in zip(confidence_intervals.BOUNDS, ends, strict=True):
            yield replace(line, bound=bound, scored=len(scored), **end)


def _figures(sent: Scored, both: Sides) -> dict[str, Any]:
    spent_s = np.where(sent.to_cloud, sent.cloud_s, sent.onboard_s)
    rule = table_two_figures.rule_figures(sent)
    kept = ("time_over_oracle", "regret_s", "regret_mean_s", "accuracy_percent", "cloud_percent")
    return _times(spent_s) | {name: rule[name] for name in kept} | {"both_percent": 100 * both.mean(-1)}


def _recorded(waited_s: Column, to_cloud: Sides) -> PolicyScore:
    """The line of the recorded run. The times of the sites that were not chosen are unknown."""
    found = _times(waited_s) | {"cloud_percent": 100 * to_cloud.mean()}
    return PolicyScore(RECORDED, scored=len(waited_s), **table_two_figures.plain(found))


def _times(seconds: Column) -> dict[str, Any]:
    return {
        "mean_s": seconds.mean(-1),
        "p95_s": table_two_figures.quantile(seconds, 95),
        "p99_s": table_two_figures.quantile(seconds, 99),
    }
