"""Predictions for sizes far beyond those that were learned: how sure they are; none is a certain 0."""

import math
from random import Random

import pytest

from offboard.robot_client import predictors
from offboard.robot_client.learning.site import SiteMemory
from offboard.robot_client.policies.forecast import WHOLE, Outlook
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, UNMEASURED, Execution

WORKLOADS = 200
FAR = 10  # tasks of each workload, up to ten times larger
HELD_MIN = 0.8  # share of them that the 90 % interval holds


class Workload:
    """Tasks whose time is linear or n log n in the size, with noise and stalls, and what is known of them."""

    def __init__(self, seed: int, predictor: str) -> None:
        self.random = random = Random(seed)
        self.smallest = 10 ** random.uniform(1, 6)
        self.largest = self.smallest * random.uniform(1.5, 4)
        self._with_log = random.random() < 0.5
        self._unit_s = 10 ** random.uniform(-8, -3)
        self._fixed_s = random.uniform(0, 1) * self._unit_s * self.smallest
        self._noise, self._stalls = random.uniform(0.05, 0.2), random.uniform(0.01, 0.2)
        self._memory = SiteMemory(
            ONBOARD,
            lambda: predictors.make(predictor, 50),
            measured=True,
            quality=WHOLE,
        )

    def run(self, size: float) -> float:
        """How long a task takes."""
        seconds = self._mean_s(size) * self.random.lognormvariate(0, self._noise)
        if self.random.random() < self._stalls:
            seconds += self._mean_s(0.5 * (self.smallest + self.largest)) * self.random.uniform(1, 10)
        return seconds

    def _mean_s(self, size: float) -> float:
        return self._fixed_s + self._unit_s * size * (math.log(size) if self._with_log else 1.0)

    def outlook(self, size: float) -> Outlook:
        return self._memory.outlook(size, UNMEASURED, in_flight=0, sending=NOTHING)

    def learn(self, tasks: int) -> None:
        for _ in range(tasks):
            size = self.random.uniform(self.smallest, self.largest)
            seconds = self.run(size)
            run = Execution(ONBOARD, seconds, run_s=seconds, queue_s=0.0)
            self._memory.learn(size, run, self.outlook(size), silent=False, size=size)

    def far_sizes(self) -> list[float]:
        return [self.largest * 10 ** self.random.uniform(0, 1) for _ in range(FAR)]


@pytest.mark.parametrize("predictor", predictors.names())
def test_the_interval_holds_most_tasks_that_are_far_larger(predictor: str) -> None:
    """After 20 to 100 tasks, the 90 % interval holds at least 80 % of tasks up to ten times larger."""
    held = 0
    for seed in range(WORKLOADS):
        workload = Workload(seed, predictor)
        workload.learn(workload.random.randint(20, 100))
        for size in workload.far_sizes():
            outlook, seconds = workload.outlook(size), workload.run(size)
            assert outlook.low_s is not None
            assert outlook.high_s is not None
            held += outlook.low_s <= seconds <= outlook.high_s
    print(f"{predictor}: {held / (WORKLOADS * FAR):.1%} held")
    assert held >= HELD_MIN * WORKLOADS * FAR


@pytest.mark.parametrize("predictor", predictors.names())
def test_an_interval_widens_with_the_distance_from_what_was_learned(predictor: str) -> None:
    """Far away, it is also wider in units of the prediction of its middle."""
    workload = Workload(3, predictor)
    workload.learn(60)
    middle = 0.5 * (workload.smallest + workload.largest)
    errors_s = [workload.outlook(middle * times).error_s for times in (1, 3, 10, 30)]
    found = [one for one in errors_s if one is not None]
    print(found)
    assert len(found) == 4
    assert found == sorted(found)
    assert found[3] > 9 * found[1]


def test_no_prediction_is_a_certain_zero() -> None:
    """A falling line says nothing of tasks beyond its zero, so their deadline is not called safe."""
    workload = Workload(1, predictors.PARTS)
    random = Random(5)
    memory = workload._memory
    for _ in range(40):
        size = random.uniform(2_000, 6_000)
        seconds = 0.05 - 5e-6 * size + random.uniform(0, 0.02)  # by chance, larger tasks were faster
        run = Execution(ONBOARD, seconds, run_s=seconds, queue_s=0.0)
        memory.learn(size, run, workload.outlook(size), silent=False, size=size)
    near, far = workload.outlook(4_000.0), workload.outlook(60_000.0)
    print(near, far)
    assert far.predicted_s is not None
    assert far.predicted_s > 0
    assert far.high_s is not None
    assert near.high_s is not None
    assert far.high_s > near.high_s
    late = far.errors.share_above(far.predicted_s, 0.05, far.spread_s, far.error_s or 0.0)
    print(late)
    assert late is not None
    assert late > 0.1
