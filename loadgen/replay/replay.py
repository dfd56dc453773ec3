"""`loadgen replay`: what each policy makes of the same measured tasks, with the `Offloader` of the robot.

Only the sites differ from those of a live run: they take as long as was measured, in virtual time.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.config import REQUIRED
from offboard.common.errors import DataError
from offboard.common.tasks import first_number
from offboard.loadgen import rivals
from offboard.loadgen.policy_name import split_objective
from offboard.loadgen.progress import progress
from offboard.loadgen.replay.dataset_file import measured_tasks, read_recorded
from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.replay.virtual_robot import VirtualRobot, compare, same_percent
from offboard.loadgen.table import confidence_intervals, table_two_figures
from offboard.loadgen.table.confidence_intervals import Picks
from offboard.loadgen.table.measured_rows import FIRST_NUMBER, Column, Rows, read_lived
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.table_formats import Table, column, headings_of
from offboard.loadgen.table.table_settings import FULL
from offboard.loadgen.table.table_two_figures import Scored, Sides
from offboard.robot_client import policies
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.policies import Policy
from offboard.robot_client.policies.objectives import MEAN, Mean
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

ORACLE = "oracle"
RECORDED = "as recorded"
OWN = "each policy's own"


@dataclass(frozen=True, slots=True)
class PolicyScore:
    """One line of the table: one policy on the `scored` tasks. None: undefined, or not known from the file.

    If a policy ran a task on both sites, its time is that of the first answer. `same_percent` is the share of
    all decisions of the run that the policy makes too, if it has learnt what the run had learnt.
    """

    policy: str = column("policy", default=REQUIRED)
    bound: str = column("bound", default="")
    scored: int = column("tasks", 0, default=0)
    mean_s: float | None = column("mean s", 5, latex="mean")
    p95_s: float | None = column("P95 s", 5, latex="P95")
    p99_s: float | None = column("P99 s", 5, latex="P99")
    time_over_oracle: float | None = column("time/oracle", 5)
    regret_s: float | None = column("regret s", 5, latex="regret")
    regret_mean_s: float | None = column("regret s/task", 5, latex="regret/task")
    accuracy_percent: float | None = column("accuracy %", 2, latex=r"acc. \%")
    cloud_percent: float | None = column("cloud %", 2)
    both_percent: float | None = column("on both sites %", 2)
    same_percent: float | None = column("as the run %", 2)
    note: str = ""


HEADINGS = headings_of(PolicyScore)
FIRST = ("same_percent", "scored", "mean_s", "p95_s", "time_over_oracle", "accuracy_percent", "cloud_percent")


@dataclass(frozen=True, slots=True)
class Replayed:
    """What became of the scored tasks: whether the cloud answered, whether two sites ran, and the seconds."""

    to_cloud: Sides
    both: Sides
    spent_s: Column

    def picked(self, picks: Picks) -> "Replayed":
        """The tasks with these indices, in their shape."""
        return Replayed(self.to_cloud[picks], self.both[picks], self.spent_s[picks])


def run_replay(path: Path, config: ReplayConfig) -> int:
    """Print the tables of `path` to stdout."""
    config.check_columns(HEADINGS)
    sys.stdout.write(config.text(tables(path, config)))
    return 0


def tables(path: Path, config: ReplayConfig) -> list[Table]:
    """One table for each feedback mode. The first line of a trace's table is the recorded run itself."""
    asked, config = config, config.as_in_the_run(path)
    rows, lived = read_noted(path, config.kind, least=0), read_lived(path, config.kind)
    if not len(rows) + rows.left_out:
        raise DataError(f"{path}: there is no {config.kind or 'task'} in this trace")
    recorded = [_recorded(lived.waited_s, lived.to_cloud)] if len(lived.waited_s) else []
    run = read_recorded(path, config.kind)
    tasks = measured_tasks(run)
    with progress("policies", len(config.modes()) * (len(config.policies) + 1)) as shown:
        same = {policy: _same_percent(run, policy, config) for policy in config.policies if recorded}
        lines = {
            mode: [*recorded, *_mode_lines(tasks, rows, config, feedback=mode, same=same, step=shown.step)]
            for mode in config.modes()
        }
    about = _about(config, asked)
    return [
        _table(path, rows, config, lines[mode], about=f"{about}, feedback {mode}", feedback=mode)
        for mode in config.modes()
    ]


def replay(tasks: Sequence[RecordedTask], policy: str, config: ReplayConfig, *, feedback: str) -> Replayed:
    """Replay the policy with this name, POLICY or POLICY+OBJECTIVE."""
    chosen, memories = _made(policy, config)
    return replay_policy(tasks, chosen, memories=memories, window=config.length, feedback=feedback)


def replay_policy(
    tasks: Sequence[RecordedTask], policy: Policy, *, memories: Memories, window: int, feedback: str
) -> Replayed:
    """Let `policy` decide every task, in order; what became of those after the first `window`.

    The warm-up runs on both sites for every policy, so that all policies are scored on the same tasks.
    """
    robot = VirtualRobot(policy, memories, tells_work=_tell_work(tasks))
    played = list(robot.play(tasks, warm_up=window, all_learn=feedback == FULL))
    return Replayed(
        to_cloud=np.array([one.to_cloud for one in played], dtype=bool),
        both=np.array([one.twice for one in played], dtype=bool),
        spent_s=np.array([one.seconds for one in played], dtype=np.float64),
    )


def best(rows: Rows) -> Replayed:
    """What the oracle makes of these rows."""
    to_cloud = rows.cloud_s < rows.onboard_s
    return Replayed(to_cloud, np.zeros_like(to_cloud), np.minimum(rows.cloud_s, rows.onboard_s))


def _same_percent(run: Sequence[RecordedTask], policy: str, config: ReplayConfig) -> float | None:
    def robot(sites: Sequence[str]) -> VirtualRobot:
        return VirtualRobot(*_made(policy, config), tells_work=_tell_work(run), sites=sites)

    return same_percent(compare(run, robot))


def _made(policy: str, config: ReplayConfig) -> tuple[Policy, Memories]:
    """The policy with this name, and what it knows of its tasks at first: nothing.

    Without a predictor in the settings, it has its own.
    """
    name, objective = split_objective(policy, "policy")
    settings = Settings(
        predictor=None if config.predictor is None else rivals.predictor(config.predictor),
        window=config.length,
        objective=config.decided_by.make(objective) if policies.weighs_cost(name) else Mean(),
        energy=config.decided_by,
        seed=config.seed,
    )
    return policies.make(name, config.seed), settings.make_memories(name)


def _takes_several_numbers(policy: str, config: ReplayConfig) -> bool:
    """Whether what this policy predicts depends on all numbers of a size."""
    name, _ = split_objective(policy, "policy")
    predicts = name not in (ONBOARD, CLOUD)
    return predicts and rivals.takes_several_numbers(config.predictor or policies.predictor_of(name))


def _tell_work(tasks: Sequence[RecordedTask]) -> bool:
    return any(one.work is not None for one in tasks)


def _about(config: ReplayConfig, asked: ReplayConfig) -> str:
    """With which predictor and window, and whether they are those of the run, because none were asked for."""
    predictor = " of the run" if config.predictor != asked.predictor else ""
    window = " of the run" if config.window != asked.window else ""
    objective = config.decided_by.objective
    weighed = "" if objective == MEAN else f", objective {objective} of the run"
    return f"predictor {config.predictor or OWN}{predictor}, window {config.length}{window}{weighed}"


def _table(
    path: Path, rows: Rows, config: ReplayConfig, lines: list[PolicyScore], *, about: str, feedback: str
) -> Table:
    absent = set() if config.bootstrap else {"bound"}
    if all(line.same_percent is None for line in lines):  # no policy of a run decided them
        absent.add("same_percent")
    return Table(
        caption=f"{path}: {rows.counted()}, {about}.",
        about=rows.about(path)
        | {"feedback": feedback, "predictor": config.predictor or OWN, "window": config.length},
        headings={name: of for name, of in HEADINGS.items() if name not in absent},
        lines=lines,
        notes=rows.notes,
        first=FIRST,
    )


def _mode_lines(
    tasks: Sequence[RecordedTask],
    rows: Rows,
    config: ReplayConfig,
    *,
    feedback: str,
    same: Mapping[str, float | None],
    step: Callable[[], object],
) -> Iterator[PolicyScore]:
    """The lines of one feedback mode; `step` is called after each policy."""
    first = rows.by_first_number()
    by_first = [replace(one, size=first_number(one.size)) for one in tasks]
    for name in (*config.policies, ORACLE):
        for line in _lines(tasks, rows, name, config, feedback=feedback):
            yield replace(line, same_percent=None if line.bound else same.get(name))
        if first is not None and name != ORACLE and _takes_several_numbers(name, config):
            for line in _lines(by_first, first, name, config, feedback=feedback):
                yield replace(line, policy=FIRST_NUMBER.format(name))
        step()


def _lines(
    tasks: Sequence[RecordedTask], rows: Rows, policy: str, config: ReplayConfig, *, feedback: str
) -> Iterator[PolicyScore]:
    """The figures of one policy, and with --bootstrap the ends of their intervals."""
    line = PolicyScore(policy)
    if len(rows) <= config.length:
        both = f"{len(rows) or 'no'} tasks ran on both sites, but the warm-up needs {config.length}"
        yield replace(line, note=f"cannot be replayed: {both}")
        return
    scored = rows.since(config.length)
    played = best(scored) if policy == ORACLE else replay(tasks, policy, config, feedback=feedback)
    sent = Scored(scored.onboard_s, scored.cloud_s, played.to_cloud)
    yield replace(line, scored=len(scored), **table_two_figures.plain(_figures(sent, played)))
    if config.bootstrap:
        ends = config.blocks(len(scored)).intervals(
            lambda picks: _figures(sent.picked(picks), played.picked(picks))
        )
        for bound, end in zip(confidence_intervals.BOUNDS, ends, strict=True):
            yield replace(line, bound=bound, scored=len(scored), **end)


def _figures(sent: Scored, played: Replayed) -> dict[str, Any]:
    rule = table_two_figures.rule_figures(sent, played.spent_s)
    kept = ("time_over_oracle", "regret_s", "regret_mean_s", "accuracy_percent", "cloud_percent")
    return (
        _times(played.spent_s)
        | {name: rule[name] for name in kept}
        | {"both_percent": 100 * played.both.mean(-1)}
    )


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
