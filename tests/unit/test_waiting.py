"""Who is served next, and who has to go where all is taken."""

from collections import Counter

from offboard.cloud_server.fair_queue import CRASHED_KEPT, CRASHES_MAX, ROBOTS_MAX, Crashes, Waiting, Work
from offboard.common.wire.messages import Request


def request(robot: bytes, id: int, arrived: float = 0.0) -> Work:
    return Work(b"peer", Request(id, "kind", 1.0), {}, arrived, robot)


def served(waiting: Waiting, count: int, took_s: dict[bytes, float]) -> Counter[bytes]:
    """Robots of the next `count` that one worker takes; each robot asks again at once."""
    found: Counter[bytes] = Counter()
    for n in range(count):
        work = waiting.next()
        assert work is not None
        waiting.done(work, took_s[work.robot])
        found[work.robot] += 1
        waiting.add(request(work.robot, n))
    return found


def test_one_robot_is_served_first_come_first_served() -> None:
    """Whatever its runs take."""
    waiting = Waiting(8)
    for id in range(5):
        assert waiting.add(request(b"a", id, float(id))) is None
    order = []
    while (work := waiting.next()) is not None:
        order.append(work.request.id)
        waiting.done(work, float(10 - work.request.id))
    assert order == [0, 1, 2, 3, 4]


def test_robots_of_which_nothing_is_known_are_served_as_they_came() -> None:
    """Before anything has run, the oldest request is next."""
    waiting = Waiting(8)
    for id, robot in enumerate((b"b", b"a", b"b", b"c")):
        waiting.add(request(robot, id, float(id)))
    taken = [waiting.next() for _ in range(4)]
    assert [work.request.id for work in taken if work] == [0, 1, 2, 3]


def test_a_flood_gets_no_more_than_its_share() -> None:
    """Fifty requests of one robot and one at a time of two others: a third of the turns each."""
    waiting = Waiting(64)
    for id in range(50):
        waiting.add(request(b"flood", id))
    for robot in (b"a", b"b"):
        waiting.add(request(robot, 0))
    found = served(waiting, 300, dict.fromkeys((b"flood", b"a", b"b"), 0.01))
    assert all(abs(count - 100) <= 2 for count in found.values())


def test_shares_are_of_time_and_not_of_turns() -> None:
    """Runs that take ten times as long get a tenth of the turns."""
    waiting = Waiting(64)
    for id in range(10):
        waiting.add(request(b"long", id))
        waiting.add(request(b"short", id))
    found = served(waiting, 440, {b"long": 0.1, b"short": 0.01})
    assert abs(found[b"long"] - 40) <= 2


def test_who_was_idle_has_saved_nothing() -> None:
    """A robot that comes back is not served alone until it has had as much as the others."""
    waiting = Waiting(64)
    for id in range(4):
        waiting.add(request(b"busy", id))
    served(waiting, 200, {b"busy": 0.01})
    for id in range(4):
        waiting.add(request(b"idle", id))
    found = served(waiting, 20, {b"busy": 0.01, b"idle": 0.01})
    assert abs(found[b"busy"] - 10) <= 1


def test_where_all_is_taken_the_longest_line_gives_way() -> None:
    """Its newest request goes; it is closed to robots whose own line would be as long."""
    waiting = Waiting(4)
    for id in range(4):
        assert not waiting.closed_to(b"flood")
        waiting.add(request(b"flood", id))
    assert waiting.closed_to(b"flood")
    evicted = []
    for id in range(2):
        assert not waiting.closed_to(b"good")
        evicted.append(waiting.add(request(b"good", id)))
    assert [(work.robot, work.request.id) for work in evicted if work] == [(b"flood", 3), (b"flood", 2)]
    assert waiting.closed_to(b"good")
    assert waiting.closed_to(b"flood")
    assert not waiting.closed_to(b"other")
    assert len(waiting) == len(list(waiting)) == 4


def test_what_is_taken_out_is_gone_and_who_left_is_forgotten() -> None:
    """Cancelled or expired: the others stay in order; of many robots that came once few are remembered."""
    waiting = Waiting(8)
    for id in range(3):
        waiting.add(request(b"a", id))
        waiting.add(request(b"b", id))
    assert {work.request.id for work in waiting.take(lambda work: work.robot == b"a")} == {0, 1, 2}
    assert [work.request.id for work in waiting] == [0, 1, 2]
    while (work := waiting.next()) is not None:
        waiting.done(work, 0.01)
    assert not len(waiting)
    assert not waiting._had_s
    assert not waiting._running
    waiting.add(request(b"stays", 0))
    for n in range(2 * ROBOTS_MAX):
        waiting.add(request(f"{n}".encode(), n))
        work = waiting.next()
        assert work is not None
        waiting.done(work, 0.01)
    assert len(waiting._had_s) <= ROBOTS_MAX + 1


def test_a_request_is_refused_after_its_last_crash() -> None:
    """Its robot and its id make a request; others of the same id are not refused."""
    crashes = Crashes()
    for _ in range(CRASHES_MAX):
        assert not crashes.too_many(b"robot", 7)
        crashes.note(b"robot", 7)
    assert crashes.too_many(b"robot", 7)
    assert not crashes.too_many(b"robot", 8)
    assert not crashes.too_many(b"other", 7)


def test_what_is_remembered_of_crashes_is_bounded() -> None:
    """The request that crashed longest ago is forgotten first."""
    crashes = Crashes()
    for _ in range(CRASHES_MAX):
        for id in (1, 2):
            crashes.note(b"robot", id)
    for id in range(3, 3 + CRASHED_KEPT - 2):
        crashes.note(b"robot", id)
    crashes.note(b"robot", 1)
    crashes.note(b"robot", 0)
    assert len(crashes) == CRASHED_KEPT
    assert [crashes.too_many(b"robot", id) for id in (1, 2)] == [True, False]
