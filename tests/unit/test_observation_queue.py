"""The observations without an answer: turns, answers that are still due, and how they end."""

from typing import Any

from offboard.common.errors import CloudBroken, CloudTimeout
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.openpi.observation import Observation
from offboard.robot_client.openpi.observation_queue import QUEUE_MAX, ObservationQueue
from offboard.robot_client.sites.runner import Execution


@task("openpi_queued", policy_server=True, size=len)
def queued(observation: dict[str, Any]) -> dict[str, Any]:
    return observation


def added(queue: ObservationQueue) -> Observation:
    """A new observation that waits for its turn."""
    one = Observation("gpu", Task(kind_of(queued), ({},), 0), b"1", 0.0, 9.0)
    queue.add(one)
    queue.line_up(one)
    return one


def test_one_is_under_way_at_a_time() -> None:
    """The next one has its turn when a message has come."""
    queue = ObservationQueue()
    first, second = added(queue), added(queue)
    assert queue.send_next(1.0) is first
    assert queue.send_next(2.0) is None
    assert not queue.idle
    assert queue.take_answered() is first
    queue.end(first, Execution("gpu", 1.0))
    assert first.future.result().ok
    assert queue.find(first.task.id) is None
    assert queue.send_next(3.0) is second
    assert (first.sent_s, second.sent_s) == (1.0, 3.0)


def test_the_answer_to_one_that_was_given_up_is_still_due() -> None:
    """Until it has come, no other one has its turn."""
    queue = ObservationQueue()
    first, second = added(queue), added(queue)
    queue.send_next(1.0)
    queue.give_up(first, CloudTimeout("late"), 2.0, censored=True)
    assert first.future.result().censored
    assert queue.owed_since_s == 2.0
    assert queue.send_next(3.0) is None
    assert queue.take_answered() is first
    assert queue.owed_since_s is None
    assert queue.send_next(4.0) is second


def test_one_that_waits_can_be_given_up() -> None:
    """It never has its turn."""
    queue = ObservationQueue()
    first, second = added(queue), added(queue)
    queue.give_up(first, CloudTimeout("late"), 1.0)
    assert queue.owed_since_s is None
    assert queue.send_next(2.0) is second
    assert not first.future.result().started


def test_a_message_that_answers_nothing() -> None:
    """The queue says so."""
    assert ObservationQueue().take_answered() is None


def test_all_end_with_the_connection() -> None:
    """The next connection owes nothing."""
    queue = ObservationQueue()
    ones = [added(queue) for _ in range(QUEUE_MAX)]
    assert queue.full
    queue.send_next(1.0)
    queue.give_up(ones[0], CloudTimeout("late"), 2.0)
    queue.give_up_all(CloudBroken("lost"), 3.0)
    assert [str(one.future.result().failure) for one in ones] == ["late"] + ["lost"] * (QUEUE_MAX - 1)
    assert [one.future.result().started for one in ones] == [True] + [False] * (QUEUE_MAX - 1)
    assert queue.idle
    assert not queue.full
    assert not queue.waits
