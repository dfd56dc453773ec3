"""What one worker sends to its actor, with an actor in this process."""

from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors.executor import Call
from offboard.cloud_server.executors.ray_actor import ActorSetup
from offboard.cloud_server.executors.worker import FAILED_PAUSE_S, Assignment, Died
from tests.executor_tasks import call, value
from tests.ray.handles import PID, Clock, Handle, StandIn

SETUP = ActorSetup((), (), 0)


class Place:
    """A RayWorker, and the thread of its executor, which is the one of the test."""

    def __init__(self, cluster: StandIn) -> None:
        from offboard.cloud_server.executors.ray_worker import RayWorker

        self.cluster = cluster
        self.deaths: list[Died] = []
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.worker = RayWorker(
            cluster,  # type: ignore[arg-type]
            SETUP,
            post=self._events.put,
            free=lambda _: None,
            died=lambda _, died: self.deaths.append(died),
        )

    @property
    def actor(self) -> Handle:
        return self.cluster.actors[-1]

    def start(self) -> None:
        """The worker gets its actor."""
        self.look()
        self.actor.take("start")[0].answer()
        self.look()

    def look(self) -> None:
        """What the executor does all the time."""
        while not self._events.empty():
            self._events.get()()
        self.worker.tend(())

    def give(self, call: Call, *kept: bytes) -> Assignment:
        """The executor keeps these blobs now, and has none else."""
        assignment, references = Assignment(call), {one: call.blobs[one].data for one in call.blobs}
        self.worker.give(assignment, references, kept.__contains__)
        return assignment

    def finish(self, assignment: Assignment) -> Any:
        """The actor answers everything, the newest call first; what the task returned."""
        for one in reversed(self.actor.sent):
            one.answer()
        self.actor.sent.clear()
        self.look()
        return value(assignment.answer.result(0))


@pytest.fixture
def place(stand_in: StandIn) -> Place:
    """A worker that is up."""
    made = Place(stand_in)
    made.start()
    return made


def test_an_unwanted_run_is_asked_to_stop_once(place: Place) -> None:
    """Also if the task goes on: the answer to `stop` wakes the thread, which would send the next one."""
    for number in (1, 2):
        place.give(Call("any", (), wanted=lambda: False))
        asked = list[Any]()
        for _ in range(3):
            place.look()
            for stop in place.actor.take("stop"):
                asked.append(stop.args)
                stop.answer()
        assert asked == [(number,)]
        place.actor.take("run")[0].answer()
        place.look()


@pytest.mark.usefixtures("module")
def test_a_blob_that_comes_back_is_sent_again(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another blob displaced it. Looks at the actor change nothing, in whatever order they arrive."""
    from offboard.cloud_server.executors import ray_worker

    monkeypatch.setattr(ray_worker, "LOOK_EVERY_S", 0.0)
    first, second = (call("exec_sum", np.full(50_000, number, float)) for number in (1, 2))
    for one, total in ((first, 50_000), (second, 100_000), (first, 50_000), (first, 50_000)):
        assignment = place.give(one, *one.blobs)
        place.look()
        assert place.finish(assignment) == total
        assert place.worker.known == set(place.actor.process._blobs) == set(one.blobs)
    assert not place.deaths


@pytest.mark.parametrize("at_once", [True, False])
def test_a_call_that_ray_refuses_loses_only_the_actor(place: Place, at_once: bool) -> None:
    """Its task is answered, and the next actor starts."""
    if not at_once:
        assignment = place.give(Call("any", (), wanted=lambda: False))
    place.actor.refuses = True
    if at_once:
        assignment = place.give(Call("any", ()))
    place.look()  # sends a stop if the run was sent
    place.look()
    assert assignment.answer.result(0).crashed
    assert [one.reason for one in place.deaths] == ["exit"]
    assert place.cluster.ended == [place.cluster.actors[0]]
    place.start()
    assert (len(place.cluster.actors), place.worker.pid) == (2, PID)


def test_an_actor_that_ray_does_not_make_is_asked_for_again(
    stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every FAILED_PAUSE_S, and the reason is said each time."""
    from offboard.cloud_server.executors import ray_worker

    clock = Clock()
    monkeypatch.setattr(ray_worker, "time", clock)
    place, stand_in.refuses = Place(stand_in), True
    for deaths in (1, 1, 2):
        place.look()
        clock.now_s += FAILED_PAUSE_S / 2
        assert len(place.deaths) == deaths
    assert str(place.deaths[0]) == "did not start: RuntimeError: the head does not answer"
    stand_in.refuses = False
    clock.now_s += FAILED_PAUSE_S
    place.start()
    assert place.worker.pid == PID
