"""How many decisions of real runs a replay of their traces repeats, with the policy of the run."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.measure import Requirement, Table
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.play.run_files import TRACE
from offboard.loadgen.replay.recorded_tasks import read_tasks
from offboard.loadgen.replay.replay import tables as replayed
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.robot_client import policies

SCENARIOS, POLICIES = ("calm", "outage", "heavy-tail"), (policies.ALIAS, "paper")
SEEDS = 2
LEAST_PERCENT = 99


def tables() -> Iterator[Table]:
    """On loopback. The robot of each run decides with what it measures itself."""
    rows, requirements = list[list[str]](), list[Requirement]()
    for name in SCENARIOS:
        scenario = read_scenario(find_scenario(name))
        for policy in POLICIES:
            percents, decisions = list[float](), 0
            for n in range(SEEDS):
                with tempfile.TemporaryDirectory() as folder:
                    one = replace(scenario.changed(policy=policy), seed=scenario.seed + n)
                    play(one, Path(folder), quiet=True).check_robots()
                    trace = Path(folder) / TRACE
                    percents.append(_same_percent(trace, policy))
                    decisions += sum(task.decision is not None for task in read_tasks(trace, None))
            rows.append([name, policy, f"{decisions}", *(f"{percent:.2f}" for percent in percents)])
            what = f"{name}, {policy}: the lowest share"
            requirements.append(Requirement(what, min(percents), LEAST_PERCENT, "%", at_least=True))
    columns = ("scenario", "policy", "tasks", *(f"equal %, run {n + 1}" for n in range(SEEDS)))
    yield Table("Decisions that a replay repeats", columns, rows, requirements)


def _same_percent(trace: Path, policy: str) -> float:
    line = next(
        one for one in replayed(trace, ReplayConfig(policies=(policy,)))[0].lines if one.policy == policy
    )
    assert line.same_percent is not None, f"{trace} holds no decisions"
    return float(line.same_percent)
