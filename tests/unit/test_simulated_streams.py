"""Streams in scenarios: what their keys mean, and how they are simulated."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.compare.compare import run_compare
from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.play.play_scenario import figures
from offboard.loadgen.play.run_table import run_table
from offboard.loadgen.rivals.stream_rules import RULES
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation.model.task_costs import find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.records.record import ChunkRecord, Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

STREAM = """
name = "short"
[workload]
tasks = 300
[workload.stream]
hz = 30
horizon = 50
cloud_ms = 100
onboard_ms = 350
[robot]
s_per_quality = 1
[link]
delay_ms = 10
bandwidth_mbps = 50
"""
OUTAGE = """
[[event]]
at_s = 4
link = { outage = true }
[[event]]
at_s = 7
link = { outage = false }
"""


class Kept(list[Record]):
    def write(self, record: Record) -> None:
        self.append(record)

    @property
    def chunks(self) -> list[ChunkRecord]:
        return [one.chunk for one in self if one.chunk is not None]


def scenario(folder: Path, text: str) -> Scenario:
    path = folder / "short.toml"
    path.write_text(text)
    return read_scenario(path)


def played(one: Scenario) -> tuple[Outcome, Kept]:
    kept = Kept()
    tasks = {ROBOT: find_tasks(one.workload, one.seed, one.workload.tasks)}
    return simulate(one, tasks, trace=kept), kept  # type: ignore[arg-type]


def test_a_calm_stream_never_runs_empty(tmp_path: Path) -> None:
    """Each step has its line, and each chunk says when it was expected and when it came."""
    outcome, kept = played(scenario(tmp_path, STREAM))
    assert len(outcome.answered) == 300
    found = figures(outcome, scenario(tmp_path, STREAM))
    assert (found["empty_percent"], found["lost"]) == (0.0, 0.0)
    assert {one.outcome for one in kept.chunks} <= {"played", "late"}
    later = [one for one in kept.chunks if one.expected_s is not None and one.dropped is not None]
    assert all(one.dropped >= math.floor(one.arrived_s * one.hz) for one in later)
    assert 0.09 < min(one.arrived_s for one in later) < 0.16


def test_onboard_plays_in_an_outage(tmp_path: Path) -> None:
    """Chunks that the link swallows are lost, onboard takes over in time, and the server comes back."""
    outcome, kept = played(scenario(tmp_path, STREAM + OUTAGE))
    found = figures(outcome, scenario(tmp_path, STREAM + OUTAGE))
    assert found["empty_percent"] == 0.0
    assert "lost" in {one.outcome for one in kept.chunks}
    used = [one.used for one in outcome.answered]
    assert used[6 * 30] == ONBOARD
    assert used[-1] == CLOUD


@pytest.mark.parametrize("rule", RULES)
def test_a_seed_gives_the_same_steps(tmp_path: Path, rule: str) -> None:
    """With each rule."""
    one = scenario(tmp_path, STREAM + OUTAGE).changed(policy=rule)
    steps = [[(step.step, step.answer) for step in played(one)[0].answered] for _ in range(2)]
    assert steps[0] == steps[1]


def test_each_check_of_the_shipped_stream_fails_with_the_rule_that_it_names() -> None:
    """With the rule of the product all of them hold."""
    shipped = read_scenario(find_scenario("link-stream"))
    own = played(shipped)[0]
    assert [str(check) for check in shipped.checks if not check.judge(own).holds] == []
    rules = {check.fails_with for check in shipped.checks} & set(RULES)
    assert rules == {"broker", "half-empty"}
    for rule in rules:
        other = played(shipped.changed(policy=rule))[0]
        assert not any(one.judge(other).holds for one in shipped.checks if one.fails_with == rule)


def test_blending_makes_seams_smaller(tmp_path: Path) -> None:
    """By more than half, with the default."""
    one = scenario(tmp_path, STREAM)
    cut = replace(one, workload=replace(one.workload, stream_blend=0))
    seams = [figures(played(of)[0], of)["seam"] for of in (one, cut)]
    assert seams[0] is not None
    assert seams[1] is not None
    assert 0 < seams[0] < 0.5 * seams[1]


def test_the_table_of_a_stream_has_its_figures(tmp_path: Path) -> None:
    """Not the times of tasks, as a step takes none."""
    table = run_table("short", played(scenario(tmp_path, STREAM))[0])
    assert "| robot | tasks | lost | failed | empty % | age ms |  seam |" in table


def test_a_robot_gets_the_stream_as_flags(tmp_path: Path) -> None:
    """The policy of the scenario is the rule of its stream."""
    one = scenario(tmp_path, STREAM).changed(policy="broker")
    flags: dict[str, Any] = dict(setups(one, tmp_path)[ROBOT].flags)
    assert (flags["stream_rule"], flags["stream_hz"]) == ("broker", 30.0)
    assert flags["task"] == "offboard.loadgen.robot.stream_policy:follow"


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("hz = 30", "hz = 0", "short.toml: workload.stream.hz: 0.0 is below 0.001, the minimum"),
        ("hz = 30\n", "", "short.toml: workload.stream.hz is missing"),
        ("horizon = 50", "horison = 50", "short.toml:7: unknown key 'horison'; did you mean 'horizon'?"),
        (
            "horizon = 50",
            "horizon = 50\ncalls_per_s = 0.1",
            "short.toml:8: workload.stream.calls_per_s: calls_per_s 0.1: must be at least 0.6",
        ),
        ("tasks = 300", 'tasks = 300\narrivals = "poisson"\nrate = 1', "workload.arrivals"),
        ("tasks = 300", "tasks = 300\nmeasure = 4", "workload.measure: 4 cannot be combined with"),
        ("s_per_quality = 1", 'policy = "paper"', "robot.policy: 'paper' is not one of stream, max-ever"),
    ],
)
def test_a_wrong_stream_is_refused(tmp_path: Path, before: str, after: str, said: str) -> None:
    """One line names the key."""
    assert before in STREAM
    with pytest.raises(DataError) as error:
        scenario(tmp_path, STREAM.replace(before, after))
    assert said in str(error.value)


def test_a_rule_of_streams_needs_a_stream() -> None:
    """A scenario with tasks has none."""
    with pytest.raises(ConfigError, match=r"robot.policy: 'broker' needs workload.stream"):
        read_scenario(find_scenario("calm")).changed(policy="broker")


def test_a_comparison_of_tasks_refuses_streams(tmp_path: Path) -> None:
    """It says how the rules of a stream are compared."""
    scenario(tmp_path, STREAM)
    with pytest.raises(ConfigError, match=r"short is a stream; compare its rules by loadgen checks short"):
        run_compare([str(tmp_path / "short.toml")], CompareConfig())
