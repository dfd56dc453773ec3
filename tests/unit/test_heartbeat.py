"""Heartbeats: when they are due, and what their answers say about a site."""

import time

import pytest

from offboard.robot_client.sites.heartbeat import (
    EVERY_S,
    IDLE_S,
    JITTER,
    LOADED_SLOWER,
    SILENT_S,
    SLACK_S,
    UNANSWERED_MAX,
    Background,
    Heartbeat,
    ServerReport,
)
from offboard.robot_client.sites.runner import Condition

TRIP_S = 0.03
IDLE = ServerReport()


def beating(until_s: float, trip_s: float = TRIP_S, queue: int = 0) -> Heartbeat:
    """Heartbeats from 0 s on, each answered after `trip_s`."""
    heartbeat = Heartbeat(EVERY_S, seed=1)
    heartbeat.start(0.0)
    while heartbeat.due_s < until_s:
        now_s = heartbeat.due_s
        heartbeat.answer(heartbeat.beat(now_s), now_s + trip_s, ServerReport(queue))
    return heartbeat


def test_any_answer_updates_the_load_of_the_server() -> None:
    """Load and capacity hold while later heartbeats are unanswered, and are forgotten with the connection."""
    heartbeat = beating(2.0)
    assert (heartbeat.condition(2.0).server_load, heartbeat.condition(2.0).capacity) == (0.0, 1.0)
    heartbeat.hear(2.0, ServerReport(0, 0.75, 0.5))
    heartbeat.beat(2.1)
    for now_s in (2.0, 2.2, 9.0):
        assert (heartbeat.condition(now_s).server_load, heartbeat.condition(now_s).capacity) == (0.75, 0.5)
    heartbeat.start(10.0)
    assert (heartbeat.condition(10.0).server_load, heartbeat.condition(10.0).capacity) == (0.0, 1.0)


def test_before_the_connection_nothing_is_due_or_known() -> None:
    """There is neither a round trip nor silence. The first heartbeat is due when the connection is up."""
    heartbeat = Heartbeat(EVERY_S)
    assert heartbeat.due_s == float("inf")
    assert heartbeat.condition(1e6) == Heartbeat(0.0).condition(0.0)
    heartbeat.start(3.0)
    assert heartbeat.due_s == 3.0
    assert not heartbeat.condition(1e6).silent, "no heartbeat was sent yet"


def test_a_robot_that_computes_does_not_measure_a_longer_round_trip() -> None:
    """An answer that was heard during a run onboard, or sent during one, only shortens the round trip."""
    background = Background()
    heartbeat = Heartbeat(EVERY_S, background=background)
    heartbeat.start(0.0)

    def beat(now_s: float, trip_s: float) -> float | None:
        heartbeat.answer(heartbeat.beat(now_s), now_s + trip_s, IDLE)
        return heartbeat.condition(now_s + trip_s).round_trip_s

    assert beat(1.0, 0.05) == pytest.approx(0.05)
    background.begin()
    assert beat(2.0, 0.2) == pytest.approx(0.05)
    assert beat(3.0, 0.02) == pytest.approx(0.02)
    background.end()
    assert beat(0.0, 0.2) == pytest.approx(0.02), "a run ended after the heartbeat was sent"
    idle_s = time.perf_counter() + 1.0
    beat(idle_s, 0.2)
    assert beat(idle_s + 1.0, 0.2) == pytest.approx(0.2)


def test_a_loaded_robot_sends_fewer_heartbeats() -> None:
    """While other programs take the CPU, the pauses are LOADED_SLOWER times as long."""
    background = Background()
    usual, loaded = Heartbeat(EVERY_S), Heartbeat(EVERY_S, background=background)
    background.loaded = True
    for heartbeat in (usual, loaded):
        heartbeat.start(0.0)
        heartbeat.beat(0.0)
    assert loaded.due_s == pytest.approx(LOADED_SLOWER * usual.due_s)


def test_heartbeats_can_be_switched_off() -> None:
    """With every_s 0 no heartbeat is ever due."""
    heartbeat = Heartbeat(0.0)
    heartbeat.start(3.0)
    assert heartbeat.due_s == float("inf")


def test_pauses_are_jittered() -> None:
    """Pauses differ from EVERY_S by at most a fifth, and another seed gives other pauses."""
    heartbeat, other = Heartbeat(EVERY_S, seed=1), Heartbeat(EVERY_S, seed=2)
    pauses, others = [], []
    for one, found in ((heartbeat, pauses), (other, others)):
        one.start(0.0)
        for _ in range(50):
            now_s = one.due_s
            one.condition(now_s)
            one.answer(one.beat(now_s), now_s, IDLE)
            found.append(one.due_s - now_s)
    assert all((1 - JITTER) * EVERY_S <= pause <= (1 + JITTER) * EVERY_S for pause in pauses)
    assert max(pauses) - min(pauses) > 0.5 * JITTER * EVERY_S
    assert pauses != others


def test_the_condition_has_round_trip_and_queue() -> None:
    """Both come from the last answers."""
    condition = beating(2.0, queue=4).condition(2.0)
    assert condition.round_trip_s == pytest.approx(TRIP_S)
    assert (condition.queue, condition.silent) == (4, False)


def test_one_stalled_answer_does_not_make_a_slow_link() -> None:
    """The known round trip changes only with the second slow answer in a row."""
    heartbeat = beating(2.0)
    heartbeat.answer(heartbeat.beat(2.0), 2.2, IDLE)
    assert heartbeat.condition(2.2).round_trip_s == pytest.approx(TRIP_S)
    heartbeat.answer(heartbeat.beat(2.3), 2.5, IDLE)
    assert heartbeat.condition(2.5).round_trip_s == pytest.approx(0.2)


@pytest.mark.parametrize("reply_first", [False, True])
def test_an_answer_that_an_outage_delayed_is_no_round_trip(reply_first: bool) -> None:
    """This holds whether it or the reply to a task ends the silence. The next heartbeat is due at once."""
    heartbeat = beating(2.0)
    at_s = heartbeat.due_s
    held = [heartbeat.beat(at_s), heartbeat.beat(at_s + 0.4)]
    back_s = at_s + 0.5
    if reply_first:
        heartbeat.hear(back_s, IDLE)
    for number in held:
        heartbeat.answer(number, back_s, IDLE)
    assert heartbeat.condition(back_s).round_trip_s == pytest.approx(TRIP_S)
    assert heartbeat.due_s == back_s


def test_silence_begins_after_the_limit_and_ends_with_an_answer() -> None:
    """After SILENT_S without an answer the site is silent, until the next answer."""
    heartbeat = beating(2.0)
    at_s = heartbeat.due_s
    unanswered = heartbeat.beat(at_s)
    assert not heartbeat.condition(at_s + 0.99 * SILENT_S).silent
    assert heartbeat.condition(at_s + 1.01 * SILENT_S).silent
    heartbeat.answer(unanswered, at_s + 0.4, IDLE)
    assert not heartbeat.condition(at_s + 0.4).silent


def test_a_reply_to_a_task_ends_the_silence_too() -> None:
    """It counts as the answer to a heartbeat does, and for as long."""
    heartbeat = beating(2.0)
    at_s = heartbeat.due_s
    heartbeat.beat(at_s)
    heartbeat.hear(at_s + 0.4, ServerReport(7))
    condition = heartbeat.condition(at_s + 0.5)
    assert (condition.silent, condition.queue) == (False, 7)
    assert heartbeat.condition(at_s + 0.4 + 1.01 * SILENT_S).silent


def test_a_late_answer_is_expected_to_take_as_long_again() -> None:
    """The expected wait is the time so far. It is 0 before the answer is late, and after it has come."""
    heartbeat = beating(20.0)
    at_s = heartbeat.due_s
    unanswered = heartbeat.beat(at_s)
    late_s = TRIP_S + SLACK_S
    assert heartbeat.condition(at_s + 0.99 * late_s).wait_s == 0
    assert heartbeat.condition(at_s + 1.01 * late_s).wait_s == pytest.approx(1.01 * late_s)
    heartbeat.answer(unanswered, at_s + 0.2, IDLE)
    assert heartbeat.condition(at_s + 0.2).wait_s == 0
    first = Heartbeat(EVERY_S)
    first.start(0.0)
    first.beat(0.0)
    assert first.condition(0.2).wait_s == 0, "before the first answer no round trip is known"


def test_on_a_slow_link_silence_begins_later() -> None:
    """If round trips take half a second, an answer that takes longer than SILENT_S is normal."""
    heartbeat = beating(20.0, trip_s=0.5)
    at_s = heartbeat.due_s
    heartbeat.beat(at_s)
    assert not heartbeat.condition(at_s + 0.45).silent
    assert heartbeat.condition(at_s + 3.0).silent


@pytest.mark.parametrize("slow_from_s", [0.0, 20.0])
def test_a_link_that_stays_slow_is_not_silent(slow_from_s: float) -> None:
    """A site whose answers all take one second is not silent, at once or 10 s after its link became slow."""
    heartbeat, out = Heartbeat(EVERY_S, seed=1), list[tuple[float, int]]()
    heartbeat.start(0.0)
    silent, asked = 0, 0
    for step in range(6_000):
        now_s = step * 0.01
        while out and out[0][0] <= now_s:
            heartbeat.answer(out.pop(0)[1], now_s, IDLE)
        if heartbeat.due_s <= now_s:
            out.append((now_s + (TRIP_S if now_s < slow_from_s else 1.0), heartbeat.beat(now_s)))
        if now_s > slow_from_s + 10.0:
            asked, silent = asked + 1, silent + heartbeat.condition(now_s).silent
    assert silent == 0, f"{silent} of {asked}"
    assert heartbeat.condition(60.0).round_trip_s == pytest.approx(1.0)


def test_unanswered_heartbeats_are_bounded() -> None:
    """No more than UNANSWERED_MAX heartbeats without an answer are remembered, and the pauses stay."""
    heartbeat = Heartbeat(EVERY_S, seed=1)
    heartbeat.start(0.0)
    pauses = []
    for _ in range(100):
        now_s = heartbeat.due_s
        heartbeat.condition(now_s)
        heartbeat.beat(now_s)
        pauses.append(heartbeat.due_s - now_s)
    assert max(pauses) <= (1 + JITTER) * EVERY_S
    assert heartbeat.unanswered == UNANSWERED_MAX
    assert heartbeat.condition(heartbeat.due_s).silent


def test_an_answer_settles_earlier_heartbeats() -> None:
    """Answers keep their order, so earlier heartbeats are lost and do not count as silence."""
    heartbeat = beating(2.0)
    lost = heartbeat.beat(2.1)
    heartbeat.answer(heartbeat.beat(2.3), 2.33, IDLE)
    assert not heartbeat.condition(60.0).silent
    heartbeat.answer(lost, 9.0, ServerReport(99))
    assert heartbeat.condition(9.0).queue == 0, "a lost answer that comes anyway is ignored"


def test_a_lost_connection_leaves_its_round_trip_alone() -> None:
    """After `stop` nothing is due and old answers are ignored. The next connection starts with the last
    round trip, until its first heartbeat is answered."""
    heartbeat = beating(2.0, queue=4)
    old = heartbeat.beat(2.1)
    heartbeat.stop()
    assert heartbeat.due_s == float("inf")
    assert heartbeat.condition(9.0) == Condition(pytest.approx(TRIP_S))
    heartbeat.start(10.0)
    heartbeat.answer(old, 10.1, ServerReport(9))
    assert heartbeat.condition(10.1) == Condition(pytest.approx(TRIP_S))
    heartbeat.answer(heartbeat.beat(10.2), 10.4, IDLE)
    assert heartbeat.condition(10.5).round_trip_s == pytest.approx(0.2)


def test_a_robot_without_tasks_sends_rarer_heartbeats() -> None:
    """While nobody asks for the condition, pauses are IDLE_S; once somebody has, the next one is due soon."""
    heartbeat = beating(60.0)
    last_s = heartbeat.due_s
    heartbeat.answer(heartbeat.beat(last_s), last_s + TRIP_S, IDLE)
    assert heartbeat.due_s == pytest.approx(last_s + IDLE_S, rel=0, abs=IDLE_S * JITTER)
    heartbeat.condition(last_s + TRIP_S)
    assert heartbeat.due_s == pytest.approx(last_s + EVERY_S, rel=0, abs=EVERY_S * JITTER)


def test_with_tasks_heartbeats_stay_frequent() -> None:
    """While somebody asks at least every IDLE_S, pauses stay EVERY_S."""
    heartbeat, beats, now_s = Heartbeat(EVERY_S, seed=1), 0, 0.0
    heartbeat.start(0.0)
    while now_s < 60.0:
        heartbeat.condition(now_s)
        until_s = now_s + 0.9 * IDLE_S
        while heartbeat.due_s < until_s:
            due_s = heartbeat.due_s
            heartbeat.answer(heartbeat.beat(due_s), due_s + TRIP_S, IDLE)
            beats += 1
        now_s = until_s
    assert beats == pytest.approx(now_s / EVERY_S, rel=JITTER)
