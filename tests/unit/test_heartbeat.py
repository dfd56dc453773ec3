"""Heartbeats, in time that is an argument."""

import pytest

from offboard.robot_client.sites.heartbeat import (
    BESIDE_LEAST_OF,
    EVERY_S,
    JITTER,
    SILENT_S,
    SLACK_S,
    SLOWER,
    UNANSWERED_MAX,
    Heartbeat,
    Told,
)
from offboard.robot_client.sites.own_cpu import LATE_MAX, LOADED_SLOWER, OwnCpu
from offboard.robot_client.sites.runner import Condition

TRIP_S = 0.03
IDLE = Told()


def beating(
    until_s: float, trip_s: float = TRIP_S, queue: int = 0, own_cpu: OwnCpu | None = None
) -> Heartbeat:
    """Answered ones from 0 on."""
    heartbeat = Heartbeat(EVERY_S, seed=1, own_cpu=own_cpu)
    heartbeat.start(0.0)
    while heartbeat.due_s < until_s:
        now_s = heartbeat.due_s
        heartbeat.answer(heartbeat.beat(now_s), now_s + trip_s, Told(queue))
    return heartbeat


def test_what_the_server_says_of_its_cpu_is_told() -> None:
    """By any answer of it, also while another one is waited for; of a lost connection nothing is left."""
    heartbeat = beating(2.0)
    assert (heartbeat.condition(2.0).server_load, heartbeat.condition(2.0).capacity) == (0.0, 1.0)
    heartbeat.hear(2.0, Told(0, 0.75, 0.5))
    heartbeat.beat(2.1)
    for now_s in (2.0, 2.2, 9.0):
        assert (heartbeat.condition(now_s).server_load, heartbeat.condition(now_s).capacity) == (0.75, 0.5)
    heartbeat.start(10.0)
    assert (heartbeat.condition(10.0).server_load, heartbeat.condition(10.0).capacity) == (0.0, 1.0)


def test_before_the_connection_nothing_is_due_or_known() -> None:
    """Neither a round trip nor silence; the first is due when the connection is up."""
    heartbeat = Heartbeat(EVERY_S)
    assert heartbeat.due_s == float("inf")
    assert heartbeat.condition(1e6) == Heartbeat(0.0).condition(0.0)
    heartbeat.start(3.0)
    assert heartbeat.due_s == 3.0
    assert not heartbeat.condition(1e6).silent, "none was sent"


def test_none_are_sent_where_none_are_wanted() -> None:
    """every_s 0: no heartbeat is ever due."""
    heartbeat = Heartbeat(0.0)
    heartbeat.start(3.0)
    assert heartbeat.due_s == float("inf")


def test_they_come_in_jittered_intervals() -> None:
    """Each EVERY_S, give or take a fifth, not all alike, and those of another seed at other times."""
    heartbeat, other = Heartbeat(EVERY_S, seed=1), Heartbeat(EVERY_S, seed=2)
    pauses, others = [], []
    for one, found in ((heartbeat, pauses), (other, others)):
        one.start(0.0)
        for _ in range(50):
            now_s = one.due_s
            one.answer(one.beat(now_s), now_s, IDLE)
            found.append(one.due_s - now_s)
    assert all((1 - JITTER) * EVERY_S <= pause <= (1 + JITTER) * EVERY_S for pause in pauses)
    assert max(pauses) - min(pauses) > 0.5 * JITTER * EVERY_S
    assert pauses != others


def test_they_come_rarer_while_the_robot_is_loaded() -> None:
    """LOADED_SLOWER times as late each, and as before once the others are gone."""
    own_cpu = OwnCpu()
    heartbeat = beating(2.0, own_cpu=own_cpu)
    for loaded, slower in ((True, LOADED_SLOWER), (False, 1)):
        own_cpu.loaded = loaded
        now_s = heartbeat.due_s
        heartbeat.answer(heartbeat.beat(now_s), now_s + TRIP_S, IDLE)
        pause = (heartbeat.due_s - now_s) / EVERY_S
        assert (1 - JITTER) * slower <= pause <= (1 + JITTER) * slower


def test_round_trip_and_queue_are_told() -> None:
    """As the last answers told them."""
    condition = beating(2.0, queue=4).condition(2.0)
    assert condition.round_trip_s == pytest.approx(TRIP_S)
    assert (condition.queue, condition.silent) == (4, False)


def test_one_stalled_answer_is_no_slow_link() -> None:
    """The median of three: a second slow one moves it."""
    heartbeat = beating(2.0)
    heartbeat.answer(heartbeat.beat(2.0), 2.2, IDLE)
    assert heartbeat.condition(2.2).round_trip_s == pytest.approx(TRIP_S)
    heartbeat.answer(heartbeat.beat(2.3), 2.5, IDLE)
    assert heartbeat.condition(2.5).round_trip_s == pytest.approx(0.2)


def test_beside_an_own_run_a_round_trip_is_one_of_many() -> None:
    """Only BESIDE_LEAST_OF longer ones in a row are believed, and one that is shorter again at once."""
    own_cpu = OwnCpu()
    heartbeat = beating(2.0, own_cpu=own_cpu)
    own_cpu.begin()
    for count in range(1, BESIDE_LEAST_OF + 1):
        at_s = heartbeat.due_s
        heartbeat.answer(heartbeat.beat(at_s), at_s + 1.5 * TRIP_S, IDLE)
        known_s = heartbeat.condition(at_s + 0.1).round_trip_s
        assert known_s == pytest.approx(TRIP_S if count < BESIDE_LEAST_OF else 1.5 * TRIP_S)
    heartbeat.answer(heartbeat.beat(at_s + 1), at_s + 1 + TRIP_S, IDLE)
    assert heartbeat.condition(at_s + 1.1).round_trip_s == pytest.approx(TRIP_S)


def test_own_runs_do_not_explain_a_link_that_is_far_slower() -> None:
    """Beyond LATE_MAX times as long as known, two in a row are believed, whatever the robot computes."""
    own_cpu = OwnCpu()
    heartbeat = beating(2.0, own_cpu=own_cpu)
    own_cpu.begin()
    for at_s in (2.0, 2.5):
        heartbeat.answer(heartbeat.beat(at_s), at_s + 1.1 * LATE_MAX * TRIP_S, IDLE)
    assert heartbeat.condition(2.6).round_trip_s == pytest.approx(1.1 * LATE_MAX * TRIP_S)


def test_a_link_that_got_slow_is_so_beside_own_runs_too() -> None:
    """What was quick before two slow answers in a row is forgotten."""
    own_cpu = OwnCpu()
    heartbeat = beating(2.0, own_cpu=own_cpu)
    for at_s in (2.0, 2.3):
        heartbeat.answer(heartbeat.beat(at_s), at_s + 0.2, IDLE)
    own_cpu.begin()
    heartbeat.answer(heartbeat.beat(2.6), 2.9, IDLE)
    assert heartbeat.condition(2.9).round_trip_s == pytest.approx(0.2)


def test_a_run_that_ended_after_the_question_was_beside_it() -> None:
    """Runs that ended before it was sent are not."""
    for ended_s, known_s in ((1.9, 1.5 * TRIP_S), (2.1, TRIP_S)):
        own_cpu = OwnCpu()
        heartbeat = beating(2.0, own_cpu=own_cpu)
        own_cpu.begin()
        own_cpu.end(ended_s)
        for at_s in (2.0, 2.05):
            heartbeat.answer(heartbeat.beat(at_s), at_s + 1.5 * TRIP_S, IDLE)
        assert heartbeat.condition(2.3).round_trip_s == pytest.approx(known_s)


@pytest.mark.parametrize("reply_first", [False, True])
def test_one_that_an_outage_held_up_is_no_round_trip(reply_first: bool) -> None:
    """Be it the first that is heard again, or a task's reply; the next one is asked for at once."""
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


def test_silence_begins_after_the_limit_and_ends_with_a_word() -> None:
    """Unanswered for SILENT_S the site is silent; the next answer says that it is there."""
    heartbeat = beating(2.0)
    at_s = heartbeat.due_s
    unanswered = heartbeat.beat(at_s)
    assert not heartbeat.condition(at_s + 0.99 * SILENT_S).silent
    assert heartbeat.condition(at_s + 1.01 * SILENT_S).silent
    heartbeat.answer(unanswered, at_s + 0.4, IDLE)
    assert not heartbeat.condition(at_s + 0.4).silent


def test_any_answer_of_the_server_breaks_the_silence() -> None:
    """A reply to a task is as good as a heartbeat's, and as long."""
    heartbeat = beating(2.0)
    at_s = heartbeat.due_s
    heartbeat.beat(at_s)
    heartbeat.hear(at_s + 0.4, Told(7))
    condition = heartbeat.condition(at_s + 0.5)
    assert (condition.silent, condition.queue) == (False, 7)
    assert heartbeat.condition(at_s + 0.4 + 1.01 * SILENT_S).silent


def test_an_answer_that_is_late_holds_the_site_up_for_as_long_again() -> None:
    """Longer out than usual: as long as it is out; nothing before, and nothing once something was heard."""
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
    assert first.condition(0.2).wait_s == 0, "nothing is usual before the first answer"


def test_on_a_slow_link_silence_begins_later() -> None:
    """Where round trips take half a second, one that is out for longer than SILENT_S says nothing yet."""
    heartbeat = beating(20.0, trip_s=0.5)
    at_s = heartbeat.due_s
    heartbeat.beat(at_s)
    assert not heartbeat.condition(at_s + 0.45).silent
    assert heartbeat.condition(at_s + 3.0).silent


def test_a_link_that_is_always_slow_is_not_silent() -> None:
    """Answers that come steadily, each a second after its question, never leave the site silent for long."""
    heartbeat, out = Heartbeat(EVERY_S, seed=1), list[tuple[float, int]]()
    heartbeat.start(0.0)
    silent, asked = 0, 0
    for step in range(4_000):
        now_s = step * 0.01
        while out and out[0][0] <= now_s:
            heartbeat.answer(out.pop(0)[1], now_s, IDLE)
        if heartbeat.due_s <= now_s:
            out.append((now_s + 1.0, heartbeat.beat(now_s)))
        if now_s > 5.0:
            asked, silent = asked + 1, silent + heartbeat.condition(now_s).silent
    assert silent == 0, f"{silent} of {asked}"


def test_unanswered_ones_come_rarer_and_are_bounded() -> None:
    """With UNANSWERED_MAX out each further one comes SLOWER times as late, and no more are remembered."""
    heartbeat = Heartbeat(EVERY_S, seed=1)
    heartbeat.start(0.0)
    pauses = []
    for _ in range(100):
        now_s = heartbeat.due_s
        heartbeat.beat(now_s)
        pauses.append(heartbeat.due_s - now_s)
    assert max(pauses[:UNANSWERED_MAX]) <= (1 + JITTER) * EVERY_S
    assert min(pauses[UNANSWERED_MAX:]) >= SLOWER * (1 - JITTER) * EVERY_S
    assert len(heartbeat._sent) == UNANSWERED_MAX
    assert heartbeat.condition(heartbeat.due_s).silent


def test_an_answer_settles_those_before_it() -> None:
    """They come back in order: older ones are lost, and no silence is counted from them."""
    heartbeat = beating(2.0)
    lost = heartbeat.beat(2.1)
    heartbeat.answer(heartbeat.beat(2.3), 2.33, IDLE)
    assert not heartbeat.condition(60.0).silent
    heartbeat.answer(lost, 9.0, Told(99))
    assert heartbeat.condition(9.0).queue == 0, "an answer that is not waited for"


def test_a_lost_connection_leaves_its_round_trip_alone() -> None:
    """After stop nothing is due, and an old answer is nobody's; the next connection is not taken for no way
    at all until its first heartbeat is answered."""
    heartbeat = beating(2.0, queue=4)
    old = heartbeat.beat(2.1)
    heartbeat.stop()
    assert heartbeat.due_s == float("inf")
    assert heartbeat.condition(9.0) == Condition(pytest.approx(TRIP_S))
    heartbeat.start(10.0)
    heartbeat.answer(old, 10.1, Told(9))
    assert heartbeat.condition(10.1) == Condition(pytest.approx(TRIP_S))
    heartbeat.answer(heartbeat.beat(10.2), 10.4, IDLE)
    assert heartbeat.condition(10.5).round_trip_s == pytest.approx(0.2)
