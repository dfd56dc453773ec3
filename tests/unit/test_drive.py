"""The plans that are measured alone: their order, and what is said of them."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from common.errors import CloudTimeout
from common.maps import GridMap
from common.planner import plan_path, warm
from common.tasks import Task
from robot_client.config import RobotConfig
from robot_client.drive import WAYS, Drive, orders
from robot_client.offloader import BOTH, Offloader
from robot_client.onboard import OnboardRunner
from robot_client.policies import Paper
from robot_client.predictors import LEAST_SQUARES, make
from robot_client.runner import CLOUD, ONBOARD, Execution
from robot_client.trace import Record
from tests.fakes import ScriptedRunner

PLANS = 4
warm()  # compiles before the clock of any test runs


@pytest.mark.parametrize("seed", range(5))
def test_no_way_is_favoured(seed: int) -> None:
    """After every three plans each way was first, second and third equally often."""
    found = orders(30, seed)
    assert all(sorted(order) == sorted(WAYS) for order in found)
    for place in range(3):
        for end in range(3, 31, 3):
            assert set(Counter(order[place] for order in found[:end]).values()) == {end // 3}


def test_the_seed_decides_the_order() -> None:
    """The same seed gives the same orders, whatever their number; seeds differ; each way may follow each."""
    assert orders(9, 4)[:5] == orders(5, 4)
    assert len({tuple(orders(9, seed)) for seed in range(20)}) > 1
    follows = {pair for seed in range(20) for order in orders(9, seed) for pair in pairwise(order)}
    assert follows == {(a, b) for a in WAYS for b in WAYS if a != b}


def measured(fails: set[int]) -> tuple[list[Record], list[str]]:
    """What is recorded and said of four plans, where the cloud fails at the tasks of these numbers."""
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
    config = RobotConfig(
        map=Path("open.map"),
        cloud="tcp://cloud:5555",
        trace=Path("trace.jsonl"),
        tasks=PLANS,
        alone=PLANS,
        seed=3,
    )
    with Offloader(
        [ScriptedRunner(CLOUD, answer), OnboardRunner()],
        policy=Paper(),
        predictor=lambda: make(LEAST_SQUARES, 5),
        observers=[records.append],
    ) as offload:
        Drive(config, GridMap(cells, 0.1), offload, said.append).run_alone(offload)
    return records, said


def test_each_plan_runs_in_three_ways() -> None:
    """Three records a plan, of one size, on each site alone and on both, in the order of the seed."""
    records, said = measured(fails=set())
    sites = {ONBOARD: {ONBOARD}, CLOUD: {CLOUD}, BOTH: {ONBOARD, CLOUD}}
    wanted = [sites[way] for order in orders(PLANS, 3) for way in order]
    assert [{one.site for one in record.executions} for record in records] == wanted
    sizes = [record.size for record in records]
    assert sizes[::3] == sizes[1::3] == sizes[2::3]
    assert len(set(sizes)) == PLANS
    assert {record.decision.policy for record in records} == {"pinned"}
    assert said == ["run on each site alone and on both at once: 4 of 4 plans"]


def test_a_cloud_that_fails_is_said() -> None:
    """Plans that lack a way are counted out, wherever the cloud failed; the rest goes on."""
    records, said = measured(fails={1, 3, 4})  # the cloud takes two tasks of each plan
    assert len(records) == 3 * PLANS
    missing = "; the cloud did not answer for the others"
    assert said == [f"run on each site alone and on both at once: 2 of 4 plans{missing}"]
