"""How long a server waits for requests that could run together, and what it learns of their runs."""

import math

import pytest

from offboard.cloud_server.gathering import GROUPS_MAX, Gathering, Group, RunTimes
from offboard.common.together import Together

GROUP: Group = ("gpu", "")
TOGETHER = Together(list, at_most=8, wait_s=0.01)


def run_s(count: int) -> float:
    return 0.130 + 0.022 * count


def closed_loop(
    gathering: Gathering, robots: int, rounds: int, gap_s: float = 0.001
) -> list[tuple[int, float]]:
    """Robots that ask again right after their answers: the size of each run, and how long it was held."""
    now_s, waiting, runs = 0.0, 0, []
    for _ in range(rounds):
        free_s = now_s
        to_come = robots - waiting
        while True:  # until the run starts
            until_s = gathering.until_s(GROUP, TOGETHER, waiting, now_s) if waiting else math.inf
            if to_come and now_s + gap_s <= until_s:
                now_s += gap_s
                to_come -= 1
                waiting += 1
                gathering.arrived(GROUP, waiting - 1, now_s)
            else:
                now_s = max(now_s, until_s)
                break
        size = min(waiting, TOGETHER.at_most)
        number, held_s = gathering.began(GROUP, size, now_s)
        runs.append((size, held_s))
        waiting -= size
        for _ in range(to_come):  # they come while it runs
            gathering.arrived(GROUP, waiting, now_s + gap_s)
            waiting += 1
        now_s = max(now_s, free_s) + run_s(size)
        gathering.ended(number)
        gathering.learn("gpu", size, run_s(size))
        gathering.answered(GROUP, waiting, now_s)
    return runs


@pytest.mark.parametrize("robots", [2, 5, 8])
def test_all_robots_of_a_closed_loop_run_together(robots: int) -> None:
    """After a few runs each run holds all of them, and none is held longer than they need to come."""
    runs = closed_loop(Gathering(), robots, 20)
    assert [size for size, _ in runs[-5:]] == [robots] * 5
    assert all(held_s < 0.009 for _, held_s in runs[-5:])


def test_a_single_robot_is_not_kept_waiting() -> None:
    """Once it is known that nobody else comes, its requests start at once."""
    runs = closed_loop(Gathering(), 1, 10)
    assert [held_s for _, held_s in runs[1:]] == [0.0] * 9


def test_rare_requests_are_not_held() -> None:
    """If the next one is expected later than a whole run takes, waiting costs more than it gains."""
    gathering = Gathering()
    gathering.learn("gpu", 1, run_s(1))
    for n in range(20):
        gathering.arrived(GROUP, 0, 0.5 * n)
    assert gathering.until_s(GROUP, TOGETHER, 1, 10.0) == -math.inf


def test_no_wait_is_longer_than_allowed() -> None:
    """Of a group that has just come, nothing is known: it waits as long as `wait_s`, and no longer."""
    gathering = Gathering()
    gathering.arrived(GROUP, 0, 5.0)
    assert gathering.until_s(GROUP, TOGETHER, 1, 5.0) == pytest.approx(5.01)
    gathering.arrived(GROUP, 1, 5.009)
    assert gathering.until_s(GROUP, TOGETHER, 2, 5.009) == pytest.approx(5.01)
    assert gathering.until_s(GROUP, TOGETHER, 8, 5.009) == -math.inf, "it is full"
    assert gathering.until_s(GROUP, Together(list, wait_s=0.0), 1, 5.0) == -math.inf


def test_the_time_of_a_run_is_a_line_in_its_requests() -> None:
    """Also for sizes that were not seen; equal sizes tell no slope, and no run is free."""
    times = RunTimes()
    assert times.seconds(1) is None
    for _ in range(5):
        times.learn(8, run_s(8))
    assert times.seconds(1) == pytest.approx(run_s(8))
    for n in (1, 3, 8, 2, 8, 5):
        times.learn(n, run_s(n))
    assert times.seconds(1) == pytest.approx(run_s(1), rel=0.01)
    assert times.seconds(16) == pytest.approx(run_s(16), rel=0.01)


def test_what_others_cost_is_told_as_a_wait() -> None:
    """Of a run, a request has the part that it would have taken alone."""
    gathering = Gathering()
    for n in (1, 8, 4, 8):
        gathering.learn("gpu", n, run_s(n))
    assert gathering.own_s("gpu", 8, 2 * run_s(8)) == pytest.approx(2 * run_s(1), rel=0.01)
    assert gathering.own_s("other", 8, 1.0) == 1.0


def test_the_groups_of_keys_are_limited() -> None:
    """Robots choose keys, so the group that was unused for longest is forgotten."""
    gathering = Gathering()
    for n in range(2 * GROUPS_MAX):
        gathering.arrived(("gpu", str(n)), 0, float(n))
        gathering.arrived(GROUP, 0, float(n))
    assert len(gathering._arrivals) == GROUPS_MAX
    assert GROUP in gathering._arrivals, "it is in use"


def test_a_held_request_that_left_is_forgotten() -> None:
    """The next one, an hour later, is held anew, and counts with its own wait."""
    gathering = Gathering()
    gathering.arrived(GROUP, 0, 0.0)
    assert gathering.until_s(GROUP, TOGETHER, 1, 0.0) == pytest.approx(0.01)
    gathering.arrived(GROUP, 0, 3600.0)
    assert gathering.until_s(GROUP, TOGETHER, 1, 3600.0) == pytest.approx(3600.01)
    assert gathering.began(GROUP, 1, 3700.0)[1] == pytest.approx(0.01), "then it waited for a worker"
