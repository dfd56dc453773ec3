"""Measuring tasks on each site alone and on both: the order of the ways, and what is recorded."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import CloudTimeout
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import plan_path, warm
from offboard.common.tasks import Task
from offboard.loadgen.robot.config import DriveConfig
from offboard.loadgen.robot.references import WAYS, measure_alone, orders
from offboard.loadgen.robot.robot import SimulatedRobot
from offboard.loadgen.robot.work import Plans
from offboard.robot_client.offloader import BOTH
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner
from tests.scripted import offloader

PLANS = 4
warm()  # compiles before the clock of any test runs


@pytest.mark.parametrize("seed", range(5))
def test_each_way_has_each_place_equally_often(seed: int) -> None:
    """After every three plans, each way was first, second and third equally often."""
    found = orders(30, seed, WAYS)
    assert all(sorted(order) == sorted(WAYS) for order in found)
    for place in range(3):
        for end in range(3, 31, 3):
            assert set(Counter(order[place] for order in found[:end]).values()) == {end // 3}


def test_the_seed_decides_the_order() -> None:
    """One seed always gives the same orders, seeds differ, and each way may follow each other way."""
    assert orders(9, 4, WAYS)[:5] == orders(5, 4, WAYS)
    assert len({tuple(orders(9, seed, WAYS)) for seed in range(20)}) > 1
    follows = {pair for seed in range(20) for order in orders(9, seed, WAYS) for pair in pairwise(order)}
    assert follows == {(a, b) for a in WAYS for b in WAYS if a != b}


def measured(fails: set[int]) -> tuple[list[Record], list[str]]:
    """The records and the output for four plans; the cloud fails for the tasks with these numbers."""
    cells = np.full((40, 40), 100, np.int8)
    cells[1:-1, 1:-1] = 0
    asked = 0

    def answer(task: Task) -> Execution:
        nonlocal asked
        asked += 1
        if asked in fails:
            return Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
        return Execution(CLOUD, 0.1, plan_path(*task.args))

    records: list[Record] = []
    said: list[str] = []
    config = DriveConfig(
        map=Path("open.map"),
        cloud="tcp://cloud:5555",
        trace=Path("trace.jsonl"),
        tasks=PLANS,
        alone=PLANS,
        seed=3,
    )
    work = Plans(SimulatedRobot(GridMap(cells, 0.1), seed=3), None, jump=False)
    with offloader(ScriptedRunner(CLOUD, answer), OnboardRunner(), observers=[records.append]) as offload:
        measure_alone(config, work, offload, said.append)
    return records, said


def test_each_plan_runs_in_three_ways() -> None:
    """A plan has three records of one size, on each site alone and on both, in the order of the seed."""
    records, said = measured(fails=set())
    sites = {ONBOARD: {ONBOARD}, CLOUD: {CLOUD}, BOTH: {ONBOARD, CLOUD}}
    wanted = [sites[way] for order in orders(PLANS, 3, WAYS) for way in order]
    assert [{one.site for one in record.executions} for record in records] == wanted
    sizes = [record.size for record in records]
    assert sizes[::3] == sizes[1::3] == sizes[2::3]
    assert len(set(sizes)) == PLANS
    assert {record.decision.policy for record in records} == {"pinned"}
    assert said == ["run on each site alone and on both at once: 4 of 4 plans"]


def test_plans_that_the_cloud_failed_are_counted() -> None:
    """A plan that the cloud failed once does not count; the measurement goes on."""
    records, said = measured(fails={1, 3, 4})  # the cloud takes two tasks of each plan
    assert len(records) == 3 * PLANS
    missing = "; the cloud did not answer for the others"
    assert said == [f"run on each site alone and on both at once: 2 of 4 plans{missing}"]
