"""What the scheduler does with requests that run together, and with those that would come too late."""

import math
import time
from types import SimpleNamespace
from typing import Any

import pytest

from offboard.cloud_server.authorisation import Access
from offboard.cloud_server.executors.executor import Outcome
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.scheduler import TRIED_EVERY, Scheduler
from offboard.common.wire.blobs import BlobStore
from offboard.common.wire.messages import Reply, Request
from offboard.common.wire.values import encode
from tests.joint_tasks import joint_double, joint_once

HELD_S = 0.6  # more than the tasks allow


class Replies:
    def __init__(self) -> None:
        self.sent: list[Reply] = []

    def send(self, _peer: bytes, reply: Reply) -> None:
        self.sent.append(reply)


@pytest.fixture
def replies() -> Replies:
    return Replies()


@pytest.fixture
def scheduler(replies: Replies) -> Scheduler:
    """Of a server with one worker, which is up."""
    executor: Any = SimpleNamespace(up=1)
    sender: Any = replies
    load: Any = SimpleNamespace(hurry=lambda: None, latest=lambda: (0.0, 1.0))
    one = Scheduler(
        executor, sender, Metrics(),
        blobs=BlobStore(10**6), queue_max=100, message_bytes_max=10**6, access=Access(), load=load,
    )  # fmt: skip
    one.warm = True
    return one


def request(function: Any, id: int, useless_s: float | None = None) -> Request:
    return Request(id, function.__name__, 60.0, body=encode([1.0]).frames, useless_s=useless_s)


def ok(run_s: float = 0.1) -> Outcome:
    return Outcome("ok", "", run_s, frames=encode(2.0).frames)


@pytest.mark.parametrize("outcome", [
    Outcome("failed", "MemoryError: too little memory", server_fault=True),
    Outcome("failed", "the worker died", 0.1, crashed=True),
    Outcome("busy", "no worker can take the task"),
])  # fmt: skip
def test_a_run_without_outcomes_is_repeated_one_by_one(
    scheduler: Scheduler, replies: Replies, outcome: Outcome
) -> None:
    """No request is lost, and none runs with another one again."""
    for id in range(3):
        scheduler.request(b"robot", request(joint_double, id))
    assert scheduler.take_chosen() == []
    time.sleep(HELD_S)
    (work,) = scheduler.take_chosen()
    assert (len(work.more), scheduler.running, scheduler.waiting) == (2, 3, 0)
    scheduler.answer(work, outcome)
    answered = []
    while chosen := scheduler.take_chosen():
        (alone,) = chosen
        assert alone.more == ()
        answered.append(alone.request.id)
        scheduler.answer(alone, ok())
    assert sorted(answered) == [0, 1, 2]
    assert [one.status for one in replies.sent] == ["ok"] * 3
    assert (scheduler.running, scheduler.waiting) == (0, 0)


def test_what_must_not_run_twice_fails_with_its_run(scheduler: Scheduler, replies: Replies) -> None:
    """If the run may have begun."""
    for id in range(2):
        scheduler.request(b"robot", request(joint_once, id))
    time.sleep(HELD_S)
    (work,) = scheduler.take_chosen()
    scheduler.answer(work, Outcome("failed", "the worker died", 0.1, crashed=True))
    assert [one.status for one in replies.sent] == ["failed"] * 2
    assert (scheduler.running, scheduler.waiting) == (0, 0)


def test_no_request_is_held_past_its_own_time(scheduler: Scheduler) -> None:
    """A task may allow a longer wait than the robot that asks."""
    impatient = request(joint_once, 1)
    impatient.budget_s = 0.2
    scheduler.request(b"robot", impatient)
    assert scheduler.take_chosen() == []
    assert scheduler.wakes_s - time.monotonic() < 0.15
    time.sleep(0.12)
    assert len(scheduler.take_chosen()) == 1


def test_a_slow_first_run_does_not_lock_deadlines_out(scheduler: Scheduler, replies: Replies) -> None:
    """One of TRIED_EVERY requests runs all the same, and then the server knows better."""

    def ask(id: int) -> None:
        scheduler.request(b"robot", request(joint_double, id, useless_s=1.0))
        scheduler.wakes_s = -math.inf
        time.sleep(0.03)  # it may be held for others
        for work in scheduler.take_chosen():
            scheduler.answer(work, ok(5.0 if id == 0 else 0.1))

    for id in range(TRIED_EVERY + 5):
        ask(id)
    statuses = [one.status for one in replies.sent]
    assert statuses == ["ok", *["busy"] * (TRIED_EVERY - 1), *["ok"] * 5]
