"""What an offloader costs: its memory does not grow with the tasks, and each task calls few functions."""

import gc
import sys
import tracemalloc
from concurrent.futures import Future
from random import Random
from types import FrameType

import pytest

from benchmarks.decision import InstantRunner
from offboard.common.tasks import Task, task
from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution

GROWTH_BYTES = 20_000  # of a few megabytes: resized dictionaries, caches of small numbers
CALLS_MAX = {"paper": 190, policies.DEFAULT: 290}


@task("footed", size=lambda size: size, work=lambda size: size)
def footed(size: float) -> float:
    return size


class Forgetful(InstantRunner):
    """Late now and then, and remembers nothing."""

    def __init__(self, site: str) -> None:
        super().__init__(site)
        self._random = Random(site)

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002
        future: Future[Execution] = Future()
        seconds = task.size * self._random.lognormvariate(-4.0, 0.3)
        future.set_result(Execution(self.site, seconds, task.size, run_s=seconds, queue_s=0.0))
        return future


def offloader(policy: str) -> Offloader:
    return Offloader(
        [Forgetful(ONBOARD), Forgetful(CLOUD)],
        policy=policies.make(policy),
        memories=Settings().make_memories(policy),
    )


@pytest.mark.parametrize("policy", ["paper", policies.DEFAULT])
def test_memory_does_not_grow_with_the_tasks(policy: str) -> None:
    """After 5,000 tasks even a rarely used site is full, so 2,500 more tasks take no more memory."""
    random, held = Random(1), []
    with offloader(policy) as offload:
        tracemalloc.start()
        for count in (5_000, 2_500):
            for _ in range(count):
                offload(footed, random.uniform(1, 5))
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    print(held)
    assert held[1] - held[0] < GROWTH_BYTES, held


@pytest.mark.parametrize(("policy", "calls_max"), CALLS_MAX.items())
def test_a_task_calls_few_functions(policy: str, calls_max: int) -> None:
    """The mean number of Python functions called for a task is at most CALLS_MAX."""
    random, calls = Random(1), 0

    def count(_frame: FrameType, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    with offloader(policy) as offload:
        for _ in range(300):
            offload(footed, random.uniform(1, 5))
        sys.setprofile(count)
        for _ in range(200):
            offload(footed, random.uniform(1, 5))
        sys.setprofile(None)
    print(calls / 200)
    assert calls / 200 <= calls_max
