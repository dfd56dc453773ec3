"""How long the runs that are under way onboard should still take."""

import pytest

from offboard.common.tasks import task
from offboard.robot_client import policies
from offboard.robot_client.learning.runs_in_flight import OVERDUE, Flights
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import ONBOARD
from tests.virtual import VirtualClock, VirtualRunner

CALLS, RUN_S = 11, 1.0


@task("steady", size=lambda: 1.0)
def steady() -> None:
    pass


def flights() -> Flights:
    """CALLS runs that were started in the same moment."""
    made = Flights()
    for number in range(CALLS):
        made.begin(ONBOARD, number, kind="sleep", predicted_s=RUN_S, now_s=0.0)
    return made


def test_only_the_first_run_is_running() -> None:
    """The others wait for it: the time until now is none that they ran."""
    made = flights()
    for now_s in (0.0, 0.4):
        assert made.left_s(ONBOARD, now_s) == pytest.approx(CALLS * RUN_S - now_s)
    assert made.left_s(ONBOARD, 4.0) == pytest.approx(4.0 * OVERDUE + (CALLS - 1) * RUN_S)


def test_a_run_begins_when_the_one_before_it_ends() -> None:
    """Each run that ends makes the rest shorter by what was predicted of it; the next one starts at 0."""
    made = flights()
    for number in range(CALLS):
        end_s = (number + 1) * RUN_S
        assert made.left_s(ONBOARD, end_s - 0.4) == pytest.approx((CALLS - number) * RUN_S - 0.6)
        made.end(ONBOARD, number, now_s=end_s)
        assert made.left_s(ONBOARD, end_s) == pytest.approx((CALLS - number - 1) * RUN_S)


def test_a_run_that_is_cancelled_while_it_waits_leaves_the_first_one_running() -> None:
    """It takes its predicted time with it, and nothing else changes."""
    made = flights()
    made.end_all(5, now_s=0.3)
    assert made.count(ONBOARD) == CALLS - 1
    assert made.left_s(ONBOARD, 0.4) == pytest.approx((CALLS - 1) * RUN_S - 0.4)
    made.end(ONBOARD, 5, now_s=0.5)
    assert made.left_s(ONBOARD, 0.5) == pytest.approx((CALLS - 1) * RUN_S - 0.5)


def test_a_task_behind_eleven_is_predicted_to_take_twelve_runs() -> None:
    """What was predicted of a waiting run includes its own wait, which must not count again."""
    clock, found = VirtualClock(), list[float]()
    onboard = VirtualRunner(ONBOARD, clock, RUN_S)
    onboard.fields = {"queue_s": 0.0, "run_s": RUN_S}
    memories = Settings().make_memories(policies.DEFAULT)
    offload = Offloader([onboard], policy=policies.make(policies.DEFAULT), memories=memories, clock=clock)

    def call(more: int) -> None:
        """Make calls at the same time: the next one begins while this one waits."""
        found.append(offload.expect(steady)[ONBOARD].seconds or 0.0)
        if more:
            clock.after(0.0, lambda: call(more - 1))
            offload(steady)

    for _ in range(20):
        offload(steady)
    call(CALLS)
    assert found == pytest.approx([RUN_S * (before + 1) for before in range(CALLS + 1)], rel=0.05)
