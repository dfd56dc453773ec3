"""Which request is next, and which one leaves a full queue."""

import math
from collections import Counter

import pytest

from offboard.cloud_server.fair_queue import ROBOTS_MAX, FairQueue, Work
from offboard.common.wire.messages import Request


def request(robot: bytes, id: int, arrived: float = 0.0) -> Work:
    return Work(b"peer", Request(id, "kind", 1.0), {}, arrived, robot=robot)


def served(queue: FairQueue, count: int, took_s: dict[bytes, float]) -> Counter[bytes]:
    """For each robot, its share of the next `count` requests of one worker. Each robot asks again at once."""
    found: Counter[bytes] = Counter()
    for n in range(count):
        work = queue.next()
        assert work is not None
        queue.done(work, took_s[work.robot])
        found[work.robot] += 1
        queue.add(request(work.robot, n))
    return found


def test_one_robot_is_served_first_come_first_served() -> None:
    """The run times of its tasks do not matter."""
    queue = FairQueue(8)
    for id in range(5):
        assert queue.add(request(b"a", id, float(id))) is None
    order = []
    while (work := queue.next()) is not None:
        order.append(work.request.id)
        queue.done(work, float(10 - work.request.id))
    assert order == [0, 1, 2, 3, 4]


def test_new_robots_are_served_first_come_first_served() -> None:
    """Before any task has run, the oldest request is next."""
    queue = FairQueue(8)
    for id, robot in enumerate((b"b", b"a", b"b", b"c")):
        queue.add(request(robot, id, float(id)))
    taken = [queue.next() for _ in range(4)]
    assert [work.request.id for work in taken if work] == [0, 1, 2, 3]


def test_a_flood_gets_no_more_than_its_share() -> None:
    """One robot with fifty requests and two with one each get a third of the turns each."""
    queue = FairQueue(64)
    for id in range(50):
        queue.add(request(b"flood", id))
    for robot in (b"a", b"b"):
        queue.add(request(robot, 0))
    found = served(queue, 300, dict.fromkeys((b"flood", b"a", b"b"), 0.01))
    assert all(abs(count - 100) <= 2 for count in found.values())


def test_shares_are_shares_of_time() -> None:
    """A robot whose runs take ten times as long gets a tenth of the turns."""
    queue = FairQueue(64)
    for id in range(10):
        queue.add(request(b"long", id))
        queue.add(request(b"short", id))
    found = served(queue, 440, {b"long": 0.1, b"short": 0.01})
    assert abs(found[b"long"] - 40) <= 2


def test_an_idle_robot_saves_no_time() -> None:
    """A robot that comes back shares with the others at once, instead of catching up alone."""
    queue = FairQueue(64)
    for id in range(4):
        queue.add(request(b"busy", id))
    served(queue, 200, {b"busy": 0.01})
    for id in range(4):
        queue.add(request(b"idle", id))
    found = served(queue, 20, {b"busy": 0.01, b"idle": 0.01})
    assert abs(found[b"busy"] - 10) <= 1


def test_a_full_queue_evicts_from_the_longest_line() -> None:
    """The newest request of that line leaves. A robot with a line of the same length cannot enter."""
    queue = FairQueue(4)
    for id in range(4):
        assert not queue.closed_to(b"flood")
        queue.add(request(b"flood", id))
    assert queue.closed_to(b"flood")
    evicted = []
    for id in range(2):
        assert not queue.closed_to(b"good")
        evicted.append(queue.add(request(b"good", id)))
    assert [(work.robot, work.request.id) for work in evicted if work] == [(b"flood", 3), (b"flood", 2)]
    assert queue.closed_to(b"good")
    assert queue.closed_to(b"flood")
    assert not queue.closed_to(b"other")
    assert len(queue) == len(list(queue)) == 4


def test_taken_requests_are_gone_and_idle_robots_are_forgotten() -> None:
    """The other requests stay in order, and the memory of robots is limited."""
    queue = FairQueue(8)
    for id in range(3):
        queue.add(request(b"a", id))
        queue.add(request(b"b", id))
    assert {work.request.id for work in queue.take(lambda work: work.robot == b"a")} == {0, 1, 2}
    assert [work.request.id for work in queue] == [0, 1, 2]
    while (work := queue.next()) is not None:
        queue.done(work, 0.01)
    assert not len(queue)
    assert len(queue._had_s) == 0
    queue.add(request(b"stays", 0))
    for n in range(2 * ROBOTS_MAX):
        queue.add(request(f"{n}".encode(), n))
        work = queue.next()
        assert work is not None
        queue.done(work, 0.01)
    assert len(queue._had_s) <= ROBOTS_MAX + 1


def urgent_loop(hurries: tuple[bool, bool], count: int, took_s: float) -> Counter[bytes]:
    """Two robots, each with one request at a time that takes so long; the share of each."""
    queue, found, now_s = FairQueue(8), Counter[bytes](), 0.0
    for robot, hurry in zip((b"a", b"b"), hurries, strict=True):
        queue.add(hurried(robot, now_s, hurry=hurry))
    for _ in range(count):
        work = queue.next()
        assert work is not None
        now_s += took_s
        queue.done(work, took_s)
        found[work.robot] += 1
        queue.add(hurried(work.robot, now_s, hurry=hurries[work.robot == b"b"]))
    return found


def hurried(robot: bytes, now_s: float, *, hurry: bool) -> Work:
    work = request(robot, 0, now_s)
    work.useless_s = now_s + 1.0 if hurry else math.inf
    return work


@pytest.mark.parametrize("took_s", [0.005, 0.06, 0.3, 1.0])
def test_always_being_in_a_hurry_does_not_pay(took_s: float) -> None:
    """Over a minute, a robot that always is has at most 5 % more than an equal one, or one run."""
    found = urgent_loop((True, False), round(60 / took_s), took_s)
    assert found[b"b"] <= found[b"a"] <= max(1.05 * found[b"b"], found[b"b"] + 2)


@pytest.mark.parametrize("took_s", [0.005, 0.06, 0.3])
def test_hurried_robots_with_a_backlog_do_not_push_others_back(took_s: float) -> None:
    """Two that always have three requests waiting, and one with a single request that returns a run later."""
    queue, found = FairQueue(100), Counter[bytes]()
    for robot in (b"a", b"b"):
        for _ in range(3):
            queue.add(hurried(robot, 0.0, hurry=True))
    queue.add(hurried(b"n", 0.0, hurry=False))
    now_s, away = 0.0, False
    for _ in range(round(60 / took_s)):
        work = queue.next()
        assert work is not None
        now_s += took_s
        if away:
            queue.add(hurried(b"n", now_s, hurry=False))
        away = work.robot == b"n"
        if not away:
            queue.add(hurried(work.robot, now_s, hurry=True))
        queue.done(work, took_s)
        found[work.robot] += 1
    assert found[b"n"] >= 0.9 * min(found[b"a"], found[b"b"])


def test_the_earliest_useless_answer_goes_first() -> None:
    """Among robots that have had about as much."""
    queue = FairQueue(8)
    for robot, useless_s in ((b"a", math.inf), (b"b", 5.0), (b"c", 2.0)):
        work = request(robot, 0)
        work.useless_s = useless_s
        queue.add(work)
    order = []
    while (work := queue.next()) is not None:
        order.append(work.robot)
    assert order == [b"c", b"b", b"a"]


def test_a_request_that_is_put_back_is_the_next_of_its_robot() -> None:
    """Its run has cost nothing, and no other one is lost."""
    queue = FairQueue(8)
    for id in range(3):
        queue.add(request(b"a", id))
    first = queue.next()
    assert first is not None
    queue.put_back(first)
    assert [work.request.id for work in queue] == [0, 1, 2]
    assert len(queue) == 3
