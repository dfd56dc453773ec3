"""When executions are learnt: surprises at once, expected times together while a task is under way."""

from collections.abc import Callable
from random import Random

import pytest

from offboard.common.errors import CloudTimeout, OffloadError
from offboard.common.tasks import kind_of, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.learner import TOGETHER
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.site import SiteMemory
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.predictors import AVERAGE, LEAST_SQUARES
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.virtual import VirtualClock, VirtualRunner

ONBOARD_S, CLOUD_S = 0.1, 0.05  # per unit of size
WARM = 40


@task("learning_echo", size=lambda number: number)
def learning_echo(number: float) -> float:
    return number


class Scene:
    """A robot that knows both sites; tasks of random sizes are pinned to a site."""

    def __init__(self, predictor: str = AVERAGE, allowance: Allowance | None = None) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (ONBOARD, CLOUD)}
        self.random = Random(1)
        self.memories = Memories(lambda: predictors.make(predictor, 20))
        self.offload = Offloader(
            list(self.sites.values()),
            policy=policies.make("greedy"),
            memories=self.memories,
            allowance=allowance,
            clock=self.clock,
        )
        for _ in range(WARM):
            self.ask(ONBOARD)
            self.ask(CLOUD)
        self.offload._learner.catch_up()

    def ask(self, where: str = CLOUD, times: float = 1.0, failure: OffloadError | None = None) -> None:
        """Run a task that takes `times` as long as predicted."""
        size = self.random.uniform(1.0, 2.0)
        for site, seconds in ((ONBOARD, ONBOARD_S), (CLOUD, CLOUD_S)):
            noise = self.random.uniform(0.98, 1.02)
            fails = failure if site == CLOUD else None
            self.sites[site].scripts.append((seconds * size * noise * times, fails))
        self.offload(learning_echo, size, where=where)
        for runner in self.sites.values():
            runner.scripts.clear()

    def site(self, name: str = CLOUD) -> SiteMemory:
        return self.memories.of(kind_of(learning_echo), self.sites).site(name)

    def learnt(self, name: str = CLOUD) -> int:
        return len(self.site(name).observations) - WARM


def test_expected_times_are_learnt_together_while_the_next_task_is_under_way() -> None:
    """TOGETHER times are learnt after the next task was sent, and before its answer is there."""
    scene = Scene()
    for _ in range(TOGETHER):
        scene.ask()
    assert scene.learnt() == 0
    seen: list[tuple[int, int]] = []
    scene.clock.after(1e-6, lambda: seen.append((len(scene.sites[CLOUD].tasks), scene.learnt())))
    scene.ask()
    assert seen == [(WARM + TOGETHER + 1, TOGETHER)]
    assert scene.learnt() == TOGETHER


@pytest.mark.parametrize(
    "news",
    [
        pytest.param(lambda scene: scene.ask(times=3.0), id="late"),
        pytest.param(lambda scene: scene.ask(times=0.3), id="early"),
        pytest.param(lambda scene: scene.ask(BOTH), id="both sites"),
        pytest.param(lambda scene: scene.ask(failure=CloudTimeout("late"), times=9.0), id="failed"),
    ],
)
def test_surprises_are_learnt_at_once_after_the_times_that_wait(news: Callable[[Scene], None]) -> None:
    """The next decision knows a run that failed, was late or early, or ran on both sites."""
    scene = Scene()
    scene.ask(), scene.ask()
    assert scene.learnt() == 0
    news(scene)
    assert scene.learnt() == 3
    sizes = [one.size for one in scene.site().observations]
    assert sizes[-3:] == [one.size for one in scene.sites[CLOUD].tasks[-3:]]


def test_the_first_time_of_a_site_after_a_pause_is_learnt_at_once() -> None:
    """Even if it was predicted well, it is the first time of this site for some tasks."""
    scene = Scene()
    for _ in range(2 * TOGETHER):
        scene.ask(ONBOARD)
    scene.ask(CLOUD)
    assert scene.learnt(CLOUD) == 1


def test_the_published_rule_learns_each_task_before_the_next() -> None:
    """As in Algorithm 1, the windows of least squares hold every time before the next task."""
    scene = Scene(LEAST_SQUARES)
    for n in range(1, TOGETHER + 3):
        scene.ask()
        assert scene.learnt() == n


def test_learning_together_gives_the_same_result() -> None:
    """Observations, predictions and ages are the same as if each time were learnt at once."""
    waiting, prompt = Scene(), Scene()
    for n in range(5 * TOGETHER + 1):
        where = ONBOARD if n % 7 == 0 else CLOUD
        for scene in (waiting, prompt):
            scene.ask(where)
        prompt.offload._learner.catch_up()
        for site in (ONBOARD, CLOUD):
            assert waiting.site(site).age == prompt.site(site).age
    waiting.offload._learner.catch_up()
    for site in (ONBOARD, CLOUD):
        one, other = waiting.site(site), prompt.site(site)
        assert [(o.seconds, o.ahead) for o in one.observations] == [
            (o.seconds, o.ahead) for o in other.observations
        ]
        assert one.predictor.predict(1.5, 1) == other.predictor.predict(1.5, 1)


def test_times_that_wait_are_learnt_at_the_end() -> None:
    """`close` learns all times, so that the memory file holds all tasks."""
    scene = Scene()
    scene.ask()
    assert scene.learnt() == 0
    scene.offload.close()
    assert scene.learnt() == 1


def test_bytes_are_taken_from_the_caps_at_once() -> None:
    """The caps count a task when it ends, even if its time is learnt later."""
    allowance = Allowance(bytes_a_minute=1e6)
    scene = Scene(allowance=allowance)
    scene.sites[CLOUD].fields = {"bytes_out": 1000, "bytes_in": 0}
    before = allowance.bytes_left
    scene.ask()
    assert scene.learnt() == 0
    assert allowance.bytes_left < before
