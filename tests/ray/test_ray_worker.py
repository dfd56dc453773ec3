"""What one worker sends to its actor, with an actor in this process."""

from collections.abc import Callable, Mapping
from queue import SimpleQueue
from typing import Any

import pytest

from offboard.cloud_server.executors.ray_actor import ActorSetup
from offboard.cloud_server.executors.task_run import Call
from offboard.cloud_server.executors.worker import Assignment, Died
from tests.ray.handles import Handle, StandIn

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
        self.worker.tend((), lambda _: True)

    def give(self, call: Call, references: Mapping[bytes, Any]) -> Assignment:
        assignment = Assignment(call)
        self.worker.give(assignment, references)
        return assignment


@pytest.fixture
def place(stand_in: StandIn) -> Place:
    """A worker that is up."""
    made = Place(stand_in)
    made.start()
    return made


def test_an_unwanted_run_is_asked_to_stop_once(place: Place) -> None:
    """Also if the task goes on: the answer to `stop` wakes the thread, which would send the next one."""
    for number in (1, 2):
        place.give(Call("any", (), wanted=lambda: False), {})
        asked = list[Any]()
        for _ in range(3):
            place.look()
            for stop in place.actor.take("stop"):
                asked.append(stop.args)
                stop.answer()
        assert asked == [(number,)]
        place.actor.take("run")[0].answer()
        place.look()
