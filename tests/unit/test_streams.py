"""Streams without threads: the queue of actions, the forecast of arrival, and whom to ask when."""

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import BadValue, ConfigError
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.robot_client.streams.action_queue import ActionQueue, Chunk, Placed
from offboard.robot_client.streams.arrival import Arrival
from offboard.robot_client.streams.asking import FAILED_S, PROBE_S, Asking, Pace

PACE = Pace(hz=10.0, horizon=20)  # 2 s; a question each half second
BOTH = {CLOUD: 0.0, ONBOARD: 1.0}
LONG_S = 1.9


def chunk(first: int, *, steps: int = 20, value: float = 0.0, seen_s: float = 0.0) -> Chunk:
    """Actions that say their step, and a value."""
    numbers = np.arange(first, first + steps, dtype=np.float64)
    return Chunk(np.column_stack([numbers, np.full(steps, value)]), first, seen_s, CLOUD)


def played(queue: ActionQueue, step: int) -> list[float]:
    assert queue.playing is not None
    return [float(one) for one in queue.playing.actions[step - queue.playing.first]]


def test_steps_that_have_passed_are_dropped() -> None:
    """A chunk counts from the step of its observation."""
    queue = ActionQueue()
    assert queue.put(chunk(3), 7) == Placed(dropped=4, seam=None)
    assert queue.left(7) == 16
    assert played(queue, 7) == [7.0, 0.0]
    assert queue.left(23) == 0


def test_an_older_observation_is_dropped_whole() -> None:
    """So is a chunk whose steps have all passed."""
    queue = ActionQueue()
    queue.put(chunk(5, value=1.0), 6)
    assert queue.put(chunk(4, value=2.0), 7) is None
    assert queue.put(chunk(5, value=2.0), 7) is None
    assert played(queue, 7) == [7.0, 1.0]
    assert ActionQueue().put(chunk(0, steps=5), 5) is None


def test_the_seam_is_the_change_between_two_chunks() -> None:
    """Cut: at once. Blended: within `blend` steps, and the values in between are between both."""
    cut, blended = ActionQueue(), ActionQueue(blend=3)
    for queue in (cut, blended):
        queue.put(chunk(0, value=0.0), 1)
    assert cut.put(chunk(5, value=8.0), 6) == Placed(dropped=1, seam=8.0)
    assert blended.put(chunk(5, value=8.0), 6) == Placed(dropped=1, seam=2.0)
    assert [played(blended, step)[1] for step in range(6, 11)] == [2.0, 4.0, 6.0, 8.0, 8.0]
    assert [played(blended, step)[0] for step in range(6, 11)] == [6.0, 7.0, 8.0, 9.0, 10.0]


def test_a_blend_ends_with_the_old_chunk() -> None:
    """Where the old actions have ended, the new ones are played as they are."""
    queue = ActionQueue(blend=10)
    queue.put(chunk(0, steps=8, value=0.0), 0)
    queue.put(chunk(6, value=11.0), 6)
    assert [played(queue, step)[1] for step in (6, 7, 8)] == [1.0, 2.0, 11.0]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"other": 1}, "KeyError"),
        ([1.0, 2.0], r"shape \(2,\)"),
        (np.empty((0, 2)), r"shape \(0, 2\)"),
        (np.full((4, 2), np.inf), "not finite"),
        (np.zeros((4, 3)), r"\(3,\) in a step, but \(2,\) before"),
        (object(), "TypeError"),
    ],
)
def test_what_is_no_chunk_is_refused(answer: Any, said: str) -> None:
    """The error says what the answer is."""
    queue = ActionQueue()
    queue.put(chunk(0), 0)
    with pytest.raises(BadValue, match=said):
        queue.checked(answer, None)


def test_actions_are_read_from_answers() -> None:
    """By default they are `actions` of a dictionary, or the answer; a function may say otherwise."""
    queue, actions = ActionQueue(), [[1.0], [2.0]]
    for answer, read in (({"actions": actions}, None), (actions, None), ((9, actions), lambda one: one[1])):
        assert queue.checked(answer, read).tolist() == actions


@pytest.mark.parametrize("miss_rate", [0.01, 0.1])
def test_a_forecast_is_missed_as_often_as_asked(miss_rate: float) -> None:
    """Whatever the distribution of the delays is: here it has a long tail."""
    draw, arrival = random.Random(1), Arrival(miss_rate)
    late = count = 0
    for _ in range(20_000):
        seconds = 0.1 + draw.lognormvariate(-4.0, 1.0)
        if arrival.late_s is not None:
            count += 1
            late += seconds > arrival.late_s
        arrival.learn(seconds)
    print(f"late: {late / count:.4f}")
    assert late / count == pytest.approx(miss_rate, rel=0.3)


class Asked:
    """An `Asking` whose sites take these times, with noise of a fifth."""

    def __init__(self, pace: Pace = PACE, **seconds: float) -> None:
        self.asking = Asking(pace)
        self._draw = random.Random(1)
        self._seconds = seconds
        self._seen = 0
        self.now_s = 0.0

    def learn(self, times: int = 30) -> None:
        """Each site answers some questions in its time."""
        for _ in range(times):
            for site in self._seconds:
                self.asking.asked(site, self.now_s, seen=self._seen)
                self.arrive(site)
            self.now_s += 1.0
            self._seen += 1

    def arrive(self, site: str) -> None:
        seconds = self._seconds[site] * self._draw.uniform(0.8, 1.2)
        self.asking.arrived(site, self.now_s + seconds)

    def due(self, left_s: float, able: Mapping[str, float] = BOTH) -> list[str]:
        self._seen += 1
        sites = self.asking.due(self.now_s, left_s, able, seen=self._seen)
        for site in sites:
            self.asking.asked(site, self.now_s, seen=self._seen)
        return sites


def test_at_first_every_site_is_asked() -> None:
    """The first answer is played, and all are known from then on."""
    asked = Asked()
    assert set(asked.due(0.0)) == {CLOUD, ONBOARD}
    assert asked.due(0.0) == []


def test_a_stream_is_asked_for_as_often_as_allowed() -> None:
    """With a full queue, the better site alone is asked, `every_s` after the last question."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(LONG_S) == [CLOUD]
    asked.arrive(CLOUD)
    asked.now_s += 0.4
    assert asked.due(LONG_S) == []
    asked.now_s += 0.1
    assert asked.due(LONG_S) == [CLOUD]


def test_onboard_starts_as_late_as_it_may() -> None:
    """If the answer of the server is overdue, onboard is asked when the queue lasts as long as it needs."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(LONG_S) == [CLOUD]
    asked.now_s += 1.0
    late_s = asked.asking.late_s(ONBOARD)
    assert late_s is not None
    assert asked.due(late_s + 1.5 * PACE.step_s) == []
    assert asked.due(late_s + 0.5 * PACE.step_s) == [ONBOARD]


def test_onboard_is_spared_while_the_answer_should_come_in_time() -> None:
    """The queue is short, but the chunk that is under way should come before its end."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(0.3) == [CLOUD]
    asked.now_s += 0.05
    assert asked.due(0.25) == []


def test_onboard_is_spared_if_the_next_question_is_in_time() -> None:
    """Nothing is under way, but the server is asked soon, and its chunk should come before the queue ends."""
    asked = Asked(cloud=0.1, onboard=0.5)
    asked.learn()
    assert asked.due(LONG_S) == [CLOUD]
    asked.arrive(CLOUD)
    asked.now_s += 0.1
    late_s = asked.asking.late_s(ONBOARD)
    assert late_s is not None
    assert asked.due(late_s) == []
    assert asked.due(0.3) == [ONBOARD]


def test_a_silent_server_makes_onboard_the_home() -> None:
    """Without a server, onboard is asked at the usual rate, and the server again once it is able."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(LONG_S, {ONBOARD: 1.0}) == [ONBOARD]
    asked.now_s += 1.0
    assert asked.due(LONG_S) == [CLOUD]
    assert asked.asking.site == CLOUD


def test_a_server_is_the_home_again_however_many_chunks_were_lost() -> None:
    """Lost chunks make the forecast careful, but they do not say that the server is slow."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    able = {CLOUD: 0.0, ONBOARD: 0.1}
    for _ in range(60):
        assert CLOUD in asked.due(LONG_S, able)
        asked.asking.lost(CLOUD)
        asked.now_s += PACE.every_s
    assert CLOUD in asked.due(LONG_S, able)
    asked.asking.failed(CLOUD, asked.now_s)
    asked.now_s += 0.5 * FAILED_S
    asked.due(LONG_S, able)
    assert asked.asking.site == ONBOARD
    asked.now_s += FAILED_S
    assert CLOUD in asked.due(LONG_S, able)
    assert asked.asking.site == CLOUD


def test_a_server_that_was_left_is_asked_as_often_as_before() -> None:
    """While onboard is the home: otherwise several rare probes would pass until the server is it again."""
    asking, lost_s = Asking(PACE), {CLOUD: 0.0, ONBOARD: 0.5}

    def take(site: str, at_s: float, seconds: float) -> None:
        asking.asked(site, at_s, seen=int(10 * at_s))
        asking.arrived(site, at_s + seconds)

    take(CLOUD, 0.0, 0.1)
    for number in range(6):
        take(ONBOARD, 2.0 * number, 0.4)
    asking.due(12.0, LONG_S, lost_s, seen=120)
    for number in range(7, 16):  # the link holds everything back
        take(CLOUD, 2.0 * number, 1.9)
    homes = []
    for number in range(80, 120):
        now_s = 0.5 * number
        for site in asking.due(now_s, LONG_S, lost_s, seen=5 * number):
            take(site, now_s, 0.1 if site == CLOUD else 0.4)
            homes.append((site, asking.site))
    assert homes.count((CLOUD, ONBOARD)) > 10  # in at most 20 s, in which there are two probes
    assert homes[-1] == (CLOUD, CLOUD)


def test_a_failed_site_is_left_out_for_a_while() -> None:
    """A chunk that was refused says that the next one would be, too."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(LONG_S) == [CLOUD]
    asked.asking.failed(CLOUD, asked.now_s)
    asked.now_s += 0.9 * FAILED_S
    assert CLOUD not in asked.due(LONG_S)
    asked.now_s += 0.2 * FAILED_S
    assert CLOUD in asked.due(LONG_S)


@pytest.mark.parametrize(("edge_s", "stays"), [(0.105, True), (0.3, False)])
def test_a_stream_stays_unless_leaving_pays(edge_s: float, *, stays: bool) -> None:
    """A server that is hardly better is not worth another policy; the other one is tried once in PROBE_S."""
    asked = Asked(cloud=0.10, edge=edge_s, onboard=0.6)
    able = {CLOUD: 0.0, "edge": 0.0, ONBOARD: 1.0}
    asked.learn()
    asked.asking.site = "edge"
    home, other = ("edge", CLOUD) if stays else (CLOUD, "edge")
    probed = 0
    for _ in range(int(3 * PROBE_S / PACE.every_s)):
        sites = asked.due(LONG_S, able)
        assert home in sites
        probed += other in sites
        for site in sites:
            asked.arrive(site)
        asked.now_s += PACE.every_s
    assert 2 <= probed <= 4
    assert asked.asking.site == home


def test_no_site_is_asked_about_the_same_observation_twice() -> None:
    """If nothing new is seen, the answer would be no fresher."""
    asked = Asked(cloud=0.1, onboard=0.4)
    asked.learn()
    assert asked.due(LONG_S) == [CLOUD]
    asked.arrive(CLOUD)
    asked.now_s += 10.0
    assert asked.asking.due(asked.now_s, LONG_S, BOTH, seen=asked._seen) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"hz": 0.0}, "hz 0.0: must be above 0"),
        ({"hz": float("nan")}, "hz nan"),
        ({"horizon": 0}, "horizon 0: must be a whole number from 1"),
        ({"horizon": 2.5}, "horizon 2.5"),
        ({"calls_per_s": 0.1}, r"calls_per_s 0.1: must be at least 0.5 \(a chunk lasts 2 s\)"),
        ({"miss_rate": 0.7}, "miss_rate 0.7: must be above 0, below 0.5"),
    ],
)
def test_a_pace_that_cannot_be_kept_is_refused(given: dict[str, Any], said: str) -> None:
    """The message names the option, its value and what is allowed."""
    with pytest.raises(ConfigError, match=said):
        Pace(**{"hz": 10.0, "horizon": 20, **given})


def test_an_answer_is_useless_once_another_site_has_taken_over() -> None:
    """Without a site that could take over before the queue ends, a late answer is better than none."""
    asking = Asking(PACE)
    assert asking.useful_s(CLOUD, 0.5, BOTH) == PACE.horizon_s, "nothing is known of onboard"
    for _ in range(30):
        asking.asked(ONBOARD, 0.0, seen=1)
        asking.arrived(ONBOARD, 0.2)
    late_s = asking.late_s(ONBOARD)
    assert late_s is not None
    assert asking.useful_s(CLOUD, late_s + 0.1, BOTH) == late_s + 0.1
    assert asking.useful_s(CLOUD, late_s - 0.1, BOTH) == PACE.horizon_s
    assert asking.useful_s(ONBOARD, late_s + 0.1, BOTH) == PACE.horizon_s, "it is the only one that is known"
    assert asking.useful_s(CLOUD, late_s + 0.1, {CLOUD: 0.0}) == PACE.horizon_s
