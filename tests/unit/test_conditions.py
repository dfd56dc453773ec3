"""A late or early answer is learnt with the load and capacity that explain it."""

import itertools
from collections.abc import Iterator

import pytest

from offboard.common.tasks import Task, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Probe
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.virtual import VirtualClock, VirtualRunner


class Scripted:
    """Decides what the test has set as `next`."""

    def __init__(self) -> None:
        self.next = Decision(ONBOARD, "plain", "scripted")

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self.next


@task("conditions_echo", size=lambda number: number)
def echo(number: int) -> int:
    return number


def cloud_answers() -> ScriptedRunner:
    return ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.01, one.args))


def test_late_times_are_learnt_with_the_load_that_explains_them() -> None:
    """If a load begins after a task was sent, it is measured again; times without load stay as predicted."""

    class Loaded(ScriptedRunner):
        def hurry(self) -> None:
            super().hurry()
            self.measured = Condition(load=1.0)

    home = Loaded(ONBOARD, lambda one: Execution(ONBOARD, 0.05, one.args))
    cloud = cloud_answers()
    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])
    cloud.script = lambda one: Execution(CLOUD, next(takes), one.args)
    with Offloader(
        [home, cloud], policy=policies.make(CLOUD), memories=Memories(lambda: predictors.make("average", 50))
    ) as offload:
        for _ in range(60):
            offload(echo, 2)
        for seconds in [0.1] * 6:
            home.measured = UNMEASURED  # the load was read before it began
            takes = iter([seconds])
            offload(echo, 2)
        hurried, home.measured, takes = home.hurried, UNMEASURED, iter([0.01])
        offload(echo, 2)
        assert hurried >= 6
        assert offload.last is not None
        assert offload.last.sites[CLOUD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(
    ("busy", "seconds"), [(Condition(server_load=1.0), 0.05), (Condition(capacity=0.2), 0.05)]
)
def test_late_times_are_learnt_with_what_the_server_reports_in_its_answer(
    busy: Condition, seconds: float
) -> None:
    """If a server loses CPU to others, or to a quota, its times on a whole CPU stay as predicted."""
    cloud = cloud_answers()
    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])

    def answer(one: Task) -> Execution:
        cloud.measured = says
        return Execution(CLOUD, next(takes), one.args)

    cloud.script, says = answer, UNMEASURED
    home = ScriptedRunner(ONBOARD, lambda one: Execution(ONBOARD, 0.05, one.args))
    with Offloader(
        [home, cloud], policy=policies.make(CLOUD), memories=Memories(lambda: predictors.make("average", 50))
    ) as offload:
        for _ in range(60):
            offload(echo, 2)
        takes, says = itertools.repeat(seconds), busy
        for _ in range(6):
            cloud.measured = UNMEASURED  # the last report before the task
            offload(echo, 2)
        cloud.measured = says = UNMEASURED
        takes = itertools.repeat(0.01)
        offload(echo, 2)
        assert offload.last is not None
        assert offload.last.sites[CLOUD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(("capacity", "seconds"), [(0.2, 0.02), (1.0, 0.004)])
def test_unexpected_times_are_learnt_with_the_capacity_that_explains_them(
    capacity: float, seconds: float
) -> None:
    """If the CPU quota of the robot changes, its times on a whole CPU stay as predicted."""
    before = true = Condition(capacity=0.4)

    class Held(ScriptedRunner):
        def hurry(self) -> None:
            super().hurry()
            self.measured = true

    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])
    home = Held(ONBOARD, lambda one: Execution(ONBOARD, next(takes), one.args))
    home.measured = before
    with Offloader(
        [home, cloud_answers()],
        policy=policies.make(ONBOARD),
        memories=Memories(lambda: predictors.make("average", 50)),
    ) as offload:
        for _ in range(60):
            offload(echo, 2)
        takes, true = itertools.repeat(seconds), Condition(capacity=capacity)
        for _ in range(6):
            home.measured = before  # the load was read before it began
            offload(echo, 2)
        home.measured, true, takes = before, before, itertools.repeat(0.01)
        offload(echo, 2)
        assert offload.last is not None
        assert offload.last.sites[ONBOARD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(("chosen", "second", "learnt"), [(ONBOARD, CLOUD, False), (CLOUD, None, True)])
def test_a_probe_during_an_onboard_run_does_not_make_a_server_look_slow(
    chosen: str, second: str | None, learnt: bool
) -> None:
    """The busy robot may receive the answer late; without an onboard run, the late time counts."""
    policy, clock = Scripted(), VirtualClock()
    home, cloud = VirtualRunner(ONBOARD, clock, 0.02), VirtualRunner(CLOUD, clock, 0.04)
    with Offloader(
        [home, cloud], policy=policy, memories=Memories(lambda: predictors.make("average", 50)), clock=clock
    ) as offload:
        for _ in range(30):
            policy.next = Decision(CLOUD, "plain", "scripted")
            offload(echo, 2)
        cloud.takes = 0.06
        for _ in range(30):
            policy.next = Decision(chosen, "probe", "scripted", second=Probe(second) if second else None)
            offload(echo, 2)
            clock.run_out()
        policy.next = Decision(ONBOARD, "plain", "scripted")
        offload(echo, 2)
        assert offload.last is not None
        found = offload.last.sites[CLOUD].predicted_s
        assert found is not None
        assert (found > 0.045) == learnt
