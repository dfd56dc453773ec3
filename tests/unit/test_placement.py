"""Where the tasks of a batch go, with given predictions and in virtual time."""

import heapq
import itertools
from collections.abc import Iterator, Mapping, Sequence
from random import Random

import pytest

from offboard.robot_client.execution.batch import BUDGET_SHARE
from offboard.robot_client.execution.placement import (
    ONBOARD_IN_FLIGHT,
    SERVER_IN_FLIGHT,
    SERVER_IN_FLIGHT_MAX,
    Queue,
    next_start,
    takeover,
)

WITHIN_S = 1e6


def queues(*sites: str, within_s: float = WITHIN_S) -> dict[str, Queue]:
    return {site: Queue(site, within_s) for site in sites}


def makespan(
    predicted: Sequence[Mapping[str, float]],
    sites: Sequence[str],
    true: Sequence[Mapping[str, float]] | None = None,
    workers: Mapping[str, int] | None = None,
) -> float:
    """When the last task ends, if each task takes its true time and each site runs tasks in their order."""
    true = true or predicted
    held = queues(*sites)
    waiting = sorted(range(len(predicted)), key=lambda n: -min(predicted[n].values()))
    free_s = {site: [0.0] * (workers or {}).get(site, 1) for site in sites}
    ends: list[tuple[float, int, str]] = []
    now_s = 0.0
    while waiting or ends:
        while (start := next_start([predicted[n] for n in waiting], held, now_s)) is not None:
            site, number = start.site, waiting.pop(start.place)
            held[site].start(number, predicted[number][site], now_s)
            begin_s = max(now_s, heapq.heappop(free_s[site]))
            heapq.heappush(free_s[site], begin_s + true[number][site])
            heapq.heappush(ends, (begin_s + true[number][site], number, site))
            assert len(held[site].running) <= held[site].limit
        now_s, number, site = heapq.heappop(ends)
        held[site].end(number, now_s)
        held[site].hear(0.0, true[number][site])
    return now_s


def shortest(times: Sequence[float], sites: int) -> float:
    """The shortest makespan on this many equal sites, found by trying all orders."""
    return min(
        max(sum(one for one, at in zip(times, places, strict=True) if at == site) for site in range(sites))
        for places in itertools.product(range(sites), repeat=len(times))
    )


def test_grahams_example_takes_as_long_as_he_says() -> None:
    """Seven tasks on three equal sites take 11 s with the longest first, where 9 s is the optimum."""
    times = [5.0, 5.0, 4.0, 4.0, 3.0, 3.0, 3.0]
    sites = ("onboard", "edge", "cloud")
    found = makespan([dict.fromkeys(sites, one) for one in times], sites)
    assert shortest(times, 3) == 9
    assert found == pytest.approx(11)


@pytest.mark.parametrize("seed", range(20))
def test_the_last_task_ends_within_grahams_bound(seed: int) -> None:
    """On m equal sites, a batch takes at most 4/3 - 1/(3 m) of the optimum (Graham 1969)."""
    random = Random(seed)
    sites = ("onboard", "edge", "cloud")[: random.choice((2, 3))]
    times = [random.uniform(0.1, 1.0) for _ in range(random.randrange(3, 9))]
    found = makespan([dict.fromkeys(sites, one) for one in times], sites)
    bound = (4 / 3 - 1 / (3 * len(sites))) * shortest(times, len(sites))
    assert found <= bound + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_two_sites_of_any_speed_share_the_work(seed: int) -> None:
    """A batch of 60 tasks takes at most a tenth longer than perfectly shared work."""
    random = Random(seed)
    factor = random.uniform(1, 8)
    predicted = [{"onboard": factor * one, "cloud": one} for one in (random.uniform(1, 3) for _ in range(60))]
    perfect = sum(one["cloud"] for one in predicted) / (1 + 1 / factor)
    assert perfect <= makespan(predicted, ("onboard", "cloud")) <= 1.1 * perfect


def test_a_site_that_is_too_slow_gets_nothing() -> None:
    """Onboard gets no task if the cloud ends all three before onboard could end one."""
    predicted = [{"onboard": 10.0, "cloud": 1.0}] * 3
    held = queues("onboard", "cloud")
    placed = []
    while (start := next_start(predicted[len(placed) :], held, 0.0)) is not None:
        placed.append(start.site)
        held[start.site].start(len(placed), 1.0, 0.0)
    assert placed == ["cloud"] * SERVER_IN_FLIGHT


def test_a_task_waits_for_a_better_site_and_a_later_task_may_not() -> None:
    """Onboard gets the first task that it would end before the cloud, behind the tasks that wait for it."""
    predicted = [{"onboard": 4.0, "cloud": 1.0}] * 6
    held = queues("onboard", "cloud")
    for task in range(SERVER_IN_FLIGHT):
        held["cloud"].start(task, 1.0, 0.0)
    assert next_start(predicted[:1], held, 0.0) is None
    # Behind two others the cloud ends the first task after 3 s and the second after 4 s, as onboard: a tie.
    start = next_start(predicted, held, 0.0)
    assert start is not None
    assert (start.place, start.site) == (1, "onboard")


def test_wrong_predictions_are_corrected_by_tasks_that_ended() -> None:
    """A cloud that takes three times as long as predicted gets fewer of the remaining tasks."""
    predicted = [{"onboard": 1.0, "cloud": 1.0}] * 80
    true = [{"onboard": 1.0, "cloud": 3.0}] * 80
    assert makespan(predicted, ("onboard", "cloud"), true) <= 1.1 * 80 / (1 + 1 / 3)


def test_a_server_of_several_workers_gets_several_tasks() -> None:
    """With four workers and onboard, a batch takes about a fifth of the time."""
    predicted = [{"onboard": 1.0, "cloud": 1.0}] * 100
    found = makespan(predicted, ("onboard", "cloud"), workers={"cloud": 4})
    assert 20 <= found <= 1.25 * 20


@pytest.mark.parametrize(
    ("heard", "limit"),
    [
        ([(0.0, 1.0)], SERVER_IN_FLIGHT + 1),  # the server was idle when the task came
        ([(0.0, 1.0)] * 20, SERVER_IN_FLIGHT_MAX),
        ([(0.5, 1.0)] * 20, SERVER_IN_FLIGHT),
        ([(0.0, 1.0)] * 2 + [(2.0, 1.0)], SERVER_IN_FLIGHT + 1),
        ([(2.0, 1.0)] * 20, SERVER_IN_FLIGHT),
        ([(None, None)], 1),  # the task failed
    ],
)
def test_the_queue_of_a_server_sets_how_many_tasks_it_gets(
    heard: list[tuple[float | None, float | None]], limit: int
) -> None:
    """It gets one more if a task did not wait there, and one less if a task waited longer than it ran."""
    queue = Queue("cloud", WITHIN_S)
    for one in heard:
        queue.running = dict.fromkeys(range(queue.limit), 1.0)
        queue.hear(*one)
    assert queue.limit == limit


def test_onboard_gets_one_task_at_a_time() -> None:
    """The limit of onboard stays 1, whatever its queue was."""
    queue = Queue("onboard", WITHIN_S)
    queue.hear(0.0, 1.0)
    queue.start(1, 1.0, 0.0)
    assert queue.limit == ONBOARD_IN_FLIGHT == 1
    assert not queue.can_begin(1.0, 0.0)


def test_a_slow_server_gets_one_task_at_a_time() -> None:
    """A task is not queued on a server if it might reach its timeout there."""
    timeout_s = 2.0
    queue = Queue("cloud", BUDGET_SHARE * timeout_s)
    assert queue.can_begin(0.6, 0.0)
    queue.start(1, 0.6, 0.0)
    assert not queue.can_begin(0.6, 0.0)
    assert queue.can_begin(0.3, 0.0)
    assert Queue("cloud", BUDGET_SHARE * timeout_s).can_begin(5.0, 0.0)


def test_an_idle_site_takes_over_a_task_that_it_would_end_sooner() -> None:
    """It takes the task that would wait longest in the cloud, and none that the cloud would end sooner."""
    held = queues("onboard", "cloud")
    held["cloud"].start(1, 4.0, 0.0)
    held["cloud"].start(2, 4.0, 0.0)
    both = {1: {"onboard": 3.0, "cloud": 4.0}, 2: {"onboard": 3.0, "cloud": 4.0}}
    assert takeover(both, held, 0.0) == (2, "onboard")
    assert takeover({1: both[1]}, held, 0.0) == (1, "onboard")
    assert takeover({1: {"onboard": 5.0, "cloud": 4.0}}, held, 0.0) is None
    assert takeover({1: {"onboard": 3.0, "cloud": 4.0}}, held, 2.0) is None  # 2 s are left
    held["onboard"].start(3, 1.0, 0.0)
    assert takeover(both, held, 0.0) is None, "no site is idle"


def test_an_overdue_task_is_taken_over() -> None:
    """An overdue task should need as long again as it is late, so an idle site is sooner at some time."""
    held = queues("onboard", "cloud")
    held["cloud"].start(1, 1.0, 0.0)
    slow = {1: {"onboard": 3.0, "cloud": 1.0}}
    assert takeover(slow, held, 0.5) is None
    assert takeover(slow, held, 3.9) is None
    assert takeover(slow, held, 4.1) == (1, "onboard")


def test_a_site_that_comes_while_tasks_are_looked_at_is_compared_too() -> None:
    """A new server brings its queue while the predictions are read; the task goes where it ends first."""
    held = queues("onboard")

    def predicted() -> Iterator[Mapping[str, float]]:
        yield {"onboard": 1.0}
        held["g/s1"] = Queue("g/s1", WITHIN_S)
        yield {"onboard": 1.0, "g/s1": 0.1}

    held["onboard"].start(7, 1.0, 0.0)
    start = next_start(predicted(), held, 0.0)
    assert start is not None
    assert (start.place, start.site) == (1, "g/s1")
    assert start.finish_s == pytest.approx({"onboard": 3.0, "g/s1": 0.1})
