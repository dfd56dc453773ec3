"""What was learnt is recalled by the next process, less of it the longer the robot was away."""

import json
from pathlib import Path

import pytest

from offboard.common.errors import CloudTimeout
from offboard.robot_client.learning.store import HALF_LIFE_S
from offboard.robot_client.policies import Probe
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors import LEAST_SQUARES, PARTS
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.memory_robot import Robot, store_plain, store_worked


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


@pytest.mark.parametrize("name", [LEAST_SQUARES, PARTS])
def test_a_restart_at_once_predicts_the_same(robot: Robot, name: str) -> None:
    """Predictions, intervals, bytes, shares of a CPU and costs are equal to 1e-9, with every predictor."""
    with robot.started(name) as offload:
        robot.ask(offload, 150, store_worked)
        before = robot.outlooks(offload, store_worked)
    with robot.started(name) as again:
        after = robot.outlooks(again, store_worked)
    for site in (ONBOARD, CLOUD):
        for field in (
            "predicted_s",
            "spread_s",
            "low_s",
            "high_s",
            "bytes",
            "cpu_share",
            "cost",
            "observations",
            "full",
        ):
            one, other = getattr(before[site], field), getattr(after[site], field)
            assert one is not None
            assert other == pytest.approx(one, rel=1e-9), (site, field)


@pytest.mark.parametrize("away_s", [0.0, 60.0, -1e6])
def test_the_published_rule_recalls_its_windows(robot: Robot, away_s: float) -> None:
    """After a minute, or after the clock was set back, both windows hold exactly what they held."""
    with robot.started(window=50) as offload:
        robot.ask(offload, 120)
        before = [list(one.window) for one in robot.windows]
    robot.unix_s += away_s
    with robot.started(window=50) as offload:
        offload(store_plain, 2.0)
        assert not robot.records[-1].decision.both
        assert [one.full for one in robot.records[-1].sites.values()] == [True, True]
        ran = [run.site for run in robot.records[-1].executions]
        for site, window, old in zip((ONBOARD, CLOUD), robot.windows, before, strict=True):
            assert list(window.window)[: 49 if site in ran else 50] == old[1 if site in ran else 0 :]


@pytest.mark.parametrize(
    ("half_lives", "kept"), [(0.0, 200), (1.0, 100), (2.0, 50), (5.0, 7), (6.0, 0), (1e5, 0)]
)
def test_each_half_life_away_halves_what_is_recalled(robot: Robot, half_lives: float, kept: int) -> None:
    """The newest observations of each site are recalled, or none if fewer than five are left."""
    with robot.started(window=300) as offload:
        robot.ask(offload, 230)
        newest = [list(one.window)[-kept:] for one in robot.windows] if kept else [[], []]
    robot.unix_s += half_lives * HALF_LIFE_S
    with robot.started(window=300) as offload:
        found = robot.outlooks(offload)
        assert [list(one.window) for one in robot.windows] == newest
        assert found[CLOUD].age == (PROBE_EVERY if kept else 0)


def test_a_probe_comes_soon_after_a_restart(robot: Robot) -> None:
    """The slower site counts as old, so it is probed as soon as the allowance permits."""
    robot.sites[1].script = lambda one: Execution(CLOUD, 0.9, one.size)
    with robot.started(PARTS, "probe:greedy") as offload:
        robot.ask(offload, 60)
    with robot.started(PARTS, "probe:greedy") as offload:
        for _ in range(12):
            offload(store_plain, robot.random.uniform(1, 5))
    assert [one.decision.second for one in robot.records[-12:]].count(Probe(CLOUD)) == 1


def test_every_predictor_learns_from_the_file_of_another_one(robot: Robot) -> None:
    """Observations per work are learnt again, also by a predictor per size."""
    with robot.started(PARTS) as offload:
        robot.ask(offload, 100, store_worked)
    saved = robot.path.read_bytes()
    for name in (LEAST_SQUARES, PARTS):
        robot.path.write_bytes(saved)
        with robot.started(name, "greedy") as offload:
            predicted_s = robot.outlooks(offload, store_worked)[CLOUD].predicted_s
            assert predicted_s == pytest.approx(0.25, rel=0.15), name


def test_times_per_size_are_not_recalled_as_times_per_work(robot: Robot) -> None:
    """If the work of the results was not recorded, the sites start cold."""
    with robot.started(LEAST_SQUARES) as offload:
        robot.ask(offload, 100, store_worked)
    with robot.started(PARTS, "greedy") as offload:
        assert robot.outlooks(offload, store_worked)[CLOUD].predicted_s is None


def test_failures_in_a_row_are_recalled(robot: Robot) -> None:
    """A site that failed four times at the end of one process has four failures at the start of the next."""
    with robot.started() as offload:
        robot.ask(offload, 10)
        answers = robot.sites[1].script
        robot.sites[1].script = lambda _: Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
        robot.ask(offload, 4)
        robot.sites[1].script = answers
    found = robot.outlooks(robot.started())
    assert (found[CLOUD].failures, found[ONBOARD].failures) == (4, 0)


def test_a_changed_function_starts_cold(robot: Robot) -> None:
    """If the source of a task changed, its kind knows nothing; other kinds recall what they knew."""
    with robot.started() as offload:
        robot.ask(offload, 20)
        robot.ask(offload, 20, store_worked)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["source"] = "0" * 64
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload, store_plain)[CLOUD].predicted_s is None
        assert robot.outlooks(offload, store_worked)[CLOUD].predicted_s is not None


def test_unused_kinds_and_absent_sites_stay_in_the_file(robot: Robot) -> None:
    """They keep their own time of saving, so they go on fading."""
    with robot.started() as offload:
        robot.ask(offload, 100)
        robot.ask(offload, 100, store_worked)
    before = robot.unix_s
    robot.unix_s += HALF_LIFE_S
    cloud = robot.sites.pop()
    with robot.started() as offload:
        offload(store_plain, 2.0)
    kinds = json.loads(robot.path.read_bytes())["kinds"]
    assert kinds["store_worked"]["sites"][CLOUD]["saved_at"] == before
    assert kinds["store_plain"]["sites"][CLOUD]["saved_at"] == before
    assert kinds["store_plain"]["sites"][ONBOARD]["saved_at"] == robot.unix_s
    robot.unix_s += HALF_LIFE_S
    robot.sites.append(cloud)
    assert robot.outlooks(robot.started())[CLOUD].observations == 25
    assert robot.outlooks(robot.started())[ONBOARD].observations == 26, (
        "50 recalled, one more, and half of them after an hour"
    )
