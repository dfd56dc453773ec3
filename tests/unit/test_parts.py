"""The parts model: the run, the queue and the network of a task are learned and predicted apart."""

import copy
import math
import pickle
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.predictors.parts import FIRST_BYTES_S, Parts
from offboard.robot_client.sites.runner import UNMEASURED, Condition
from tests.models import learn, predict

RUN_S, REST_S, RTT_S = 0.2, 0.05, 0.03  # of a task of size 1 and of 1000 bytes
NEAR = Condition(round_trip_s=RTT_S)
BYTES = 1000.0
BYTES_S = 4e6  # bytes a second of the link in these tests: a third of FIRST_BYTES_S


def run_of(size: float) -> float:
    return 0.04 + (RUN_S - 0.04) * size


def server(times: int = 30, condition: Condition = NEAR, **more: float) -> Parts:
    """A model that has learned this many exact times of a server, of random sizes."""
    rng, model = Random(1), Parts(remote=True)
    for _ in range(times):
        answer(model, rng.uniform(0.5, 2.0), condition, **more)
    return model


def answer(
    model: Parts,
    size: float = 1.0,
    condition: Condition = NEAR,
    *,
    moved: float = BYTES,
    rest_s: float = REST_S,
    slow: float = 1.0,
) -> None:
    """A server answers a task; `slow` is how many times as long it runs."""
    run_s, rtt_s = slow * run_of(size), condition.round_trip_s or 0.0
    learn(model, size, rtt_s + rest_s + run_s, run_s=run_s, queue_s=0.0, moved=moved, condition=condition)


def onboard(times: int = 30, condition: Condition = UNMEASURED, seconds: float | None = None) -> Parts:
    """A model that has learned exact times onboard, of random sizes."""
    rng, model = Random(1), Parts()
    for _ in range(times):
        size = rng.uniform(0.5, 2.0)
        learn(model, size, run_of(size) if seconds is None else seconds, condition=condition)
    return model


def predicted_s(model: Parts, size: float = 1.0, condition: Condition = NEAR, moved: float = BYTES) -> float:
    found = predict(model, size, moved=moved, condition=condition)
    assert found is not None
    return found.seconds


def test_nothing_is_known_before_the_first_run() -> None:
    """There is no prediction, and the warm-up needs WARM_UP runs."""
    model = Parts()
    assert predict(model, 1.0) is None
    for n in range(1, WARM_UP + 1):
        learn(model, 1.0, RUN_S)
        assert (model.full, len(model)) == (n >= WARM_UP, n)


def test_a_first_answer_without_payload_says_nothing_of_the_rate() -> None:
    """It takes one round trip; two answers with a payload tell the rate of the link."""
    model, payload = Parts(remote=True), 1e6
    answer(model, moved=BYTES, rest_s=0.0)
    for _ in range(2):
        answer(model, moved=payload, rest_s=payload / BYTES_S)
    assert predicted_s(model, moved=payload / 2) == pytest.approx(
        RTT_S + payload / 2 / BYTES_S + run_of(1.0), rel=0.1
    )


@pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
def test_a_server_takes_its_round_trip_the_rest_of_the_network_and_its_run(size: float) -> None:
    """The prediction of each size is the sum of the three, to 3 %."""
    assert predicted_s(server(), size) == pytest.approx(RTT_S + REST_S + run_of(size), rel=0.03)


def test_a_longer_round_trip_makes_the_prediction_longer_by_as_much() -> None:
    """The round trip of the heartbeats counts at once, without a task."""
    model = server()
    near_s = predicted_s(model)
    far = Condition(round_trip_s=RTT_S + 0.5)
    assert predicted_s(model, condition=far) - near_s == pytest.approx(0.5, abs=0.01)
    assert predicted_s(model) == pytest.approx(near_s)


@pytest.mark.parametrize("queue", [0, 1, 3])
def test_each_task_in_the_queue_takes_the_usual_run(queue: int) -> None:
    """A queue of n tasks adds n usual runs, whatever the size of the task itself."""
    model = Parts(remote=True)
    for _ in range(30):
        answer(model)
    behind = Condition(round_trip_s=RTT_S, queue=queue)
    for size in (1.0, 2.0):
        more_s = predicted_s(model, size, behind) - predicted_s(model, size)
        assert more_s == pytest.approx(queue * RUN_S, rel=0.02)


def test_what_a_server_waited_is_not_learned() -> None:
    """Answers that waited 0.5 s in the queue leave the prediction for an empty queue as it is."""
    model = server()
    before_s = predicted_s(model)
    for _ in range(10):
        learn(
            model,
            1.0,
            RTT_S + REST_S + 0.5 + RUN_S,
            run_s=RUN_S,
            queue_s=0.5,
            moved=BYTES,
            condition=Condition(round_trip_s=RTT_S, queue=2),
        )
    assert predicted_s(model) == pytest.approx(before_s, rel=0.01)


@pytest.mark.parametrize("remote", [False, True])
def test_half_of_the_cpu_doubles_the_run_and_nothing_else(remote: bool) -> None:
    """Times on half a CPU predict those on a whole one, and the other way round."""
    whole = NEAR if remote else UNMEASURED
    half = whole._replace(capacity=0.5)
    network_s = RTT_S + REST_S if remote else 0.0
    slow_model, fast_model = Parts(remote=remote), Parts(remote=remote)
    for _ in range(20):
        for model, condition, run_s in ((slow_model, half, 2 * RUN_S), (fast_model, whole, RUN_S)):
            learn(model, 1.0, network_s + run_s, run_s=run_s, queue_s=0.0, moved=BYTES, condition=condition)
    for model in (slow_model, fast_model):
        assert predicted_s(model, condition=whole) == pytest.approx(network_s + RUN_S, rel=0.02)
        assert predicted_s(model, condition=half) == pytest.approx(network_s + 2 * RUN_S, rel=0.02)


@pytest.mark.parametrize("remote", [False, True])
def test_load_slows_a_run_by_the_factor_that_was_learned(remote: bool) -> None:
    """Before any run under load, the load itself is the guess; after some, it is what they took."""
    model, alone = (server(), NEAR) if remote else (onboard(), UNMEASURED)
    loaded = alone._replace(load=0.6, server_load=0.6)
    network_s = RTT_S + REST_S if remote else 0.0
    assert predicted_s(model, condition=loaded) == pytest.approx(network_s + 1.6 * RUN_S, rel=0.03)
    for _ in range(8):
        run_s = 2.5 * RUN_S
        learn(model, 1.0, network_s + run_s, run_s=run_s, queue_s=0.0, moved=BYTES, condition=loaded)
    assert predicted_s(model, condition=loaded) == pytest.approx(network_s + 2.5 * RUN_S, rel=0.05)
    assert predicted_s(model, condition=alone) == pytest.approx(network_s + RUN_S, rel=0.03)


def test_runs_under_load_have_a_line_of_their_own() -> None:
    """A load that adds the same time to every run is learned, and runs without load stay as they were."""
    rng, model, loaded = Random(1), Parts(), Condition(load=0.6)
    for condition, added_s in ((UNMEASURED, 0.0), (loaded, 2 * RUN_S)):
        for _ in range(30):
            size = rng.uniform(0.5, 2.0)
            learn(model, size, run_of(size) + added_s, condition=condition)
    for size in (0.5, 2.0):
        assert predicted_s(model, size) == pytest.approx(run_of(size), rel=0.03)
        assert predicted_s(model, size, loaded) == pytest.approx(run_of(size) + 2 * RUN_S, rel=0.1)


def test_the_load_of_the_robot_does_not_slow_the_run_of_a_server() -> None:
    """Only `server_load` counts for a server, and only `load` onboard."""
    busy = Condition(round_trip_s=RTT_S, load=0.9)
    model = server()
    assert predicted_s(model, condition=busy) == predicted_s(model)
    crowded = Condition(round_trip_s=RTT_S, server_load=0.9)
    home = onboard()
    assert predicted_s(home, condition=crowded) == predicted_s(home)


def test_a_warm_up_under_load_still_teaches_the_run() -> None:
    """The first WARM_UP runs are learned as they are, because nothing else is known."""
    model = onboard(WARM_UP, Condition(load=0.8))
    assert model.full
    assert predicted_s(model) == pytest.approx(RUN_S, rel=0.2)


@pytest.mark.parametrize(("seen", "asked"), [((1e3, 2e5), 2e6), ((1e6, 4e6), 1e4)])
def test_bytes_predict_payloads_of_other_lengths(seen: tuple[float, float], asked: float) -> None:
    """A large payload is predicted from small ones, and a small payload from large ones."""
    rng, model = Random(3), Parts(remote=True)
    for _ in range(60):
        moved = rng.uniform(*seen)
        answer(model, moved=moved, rest_s=0.02 + moved / BYTES_S)
    true_s = RTT_S + 0.02 + asked / BYTES_S + RUN_S
    assert predicted_s(model, moved=asked) == pytest.approx(true_s, rel=0.1)


def test_bytes_that_the_server_has_cost_nothing() -> None:
    """If a payload is not sent, the prediction is shorter by its time on the link."""
    rng, model = Random(3), Parts(remote=True)
    for _ in range(60):
        moved = rng.choice((1e3, 1e6)) * rng.uniform(0.8, 1.2)
        answer(model, moved=moved, rest_s=0.02 + moved / BYTES_S)
    assert predicted_s(model, moved=1e6) - predicted_s(model, moved=0.0) == pytest.approx(
        1e6 / BYTES_S, rel=0.05
    )
    assert predicted_s(model, moved=0.0) == pytest.approx(RTT_S + 0.02 + RUN_S, rel=0.1)


def test_a_second_answer_of_more_bytes_says_what_a_byte_takes() -> None:
    """Half of what a first small answer took is put down to its bytes; a large one corrects it."""
    model = Parts(remote=True)
    for moved in (1e3, 1e6):
        answer(model, moved=moved, rest_s=0.02 + moved / BYTES_S)
    more_s = predicted_s(model, moved=1e6) - predicted_s(model, moved=1e3)
    assert more_s == pytest.approx(1e6 / BYTES_S, rel=0.2)


@pytest.mark.parametrize("rtt_s", [0.0, RTT_S])
def test_without_parts_everything_beyond_the_round_trip_is_the_run(rtt_s: float) -> None:
    """A server that says no run time is predicted by the time of its answers."""
    model, condition = Parts(remote=True), Condition(round_trip_s=rtt_s or None)
    for _ in range(20):
        learn(model, 1.0, 0.3, moved=BYTES, condition=condition)
    assert predicted_s(model, condition=condition) == pytest.approx(0.3, rel=0.01)
    assert predicted_s(model, 3.0, condition) > 0.5


def test_onboard_the_wait_for_the_cpu_is_part_of_the_run() -> None:
    """A busy CPU begins a run late; the prediction is the whole time, and not only that of the run."""
    model = Parts()
    for _ in range(20):
        learn(model, 1.0, 0.5, run_s=0.4, queue_s=0.1)
    assert predicted_s(model) == pytest.approx(0.5, rel=0.01)


def test_a_server_given_up_late_has_a_slower_network() -> None:
    """What a run took beyond its predicted time is put down to the network, not to the server's CPU."""
    model = server()
    before = predicted_s(model), predicted_s(model, condition=Condition(round_trip_s=RTT_S, queue=1))
    for _ in range(6):
        learn(model, 1.0, 2.0, ended=False, moved=BYTES, condition=NEAR)
    after = predicted_s(model), predicted_s(model, condition=Condition(round_trip_s=RTT_S, queue=1))
    assert after[0] > 1.5
    assert after[1] - after[0] == pytest.approx(before[1] - before[0], rel=0.01)


def test_a_run_given_up_late_onboard_takes_longer() -> None:
    """Onboard there is no network, so the run itself takes at least as long."""
    model = onboard()
    for _ in range(6):
        learn(model, 1.0, 2.0, ended=False, moved=0.0, condition=UNMEASURED)
    assert predicted_s(model) == pytest.approx(2.0, rel=0.2)


def test_a_server_that_does_not_tell_its_parts_is_learned_as_a_whole() -> None:
    """Without parts, all of a time counts as the run; one run that was given up late is not added to that."""
    model = Parts(remote=True)
    for _ in range(20):
        learn(model, 1.0, 0.2)
    learn(model, 1.0, 0.4, ended=False, moved=0.0, condition=UNMEASURED)
    for _ in range(20):
        learn(model, 1.0, 0.2)
    assert predicted_s(model) == pytest.approx(0.2, rel=0.2)


def test_an_answer_that_may_have_been_received_late_only_lowers_the_network() -> None:
    """With `bound`, a late answer teaches the run but not the network; an early one teaches both."""
    model = server()
    before_s = predicted_s(model)
    for rest_s, expected_s in ((0.5, before_s), (0.01, RTT_S + 0.01 + RUN_S)):
        for _ in range(5):
            learn(
                model,
                1.0,
                RTT_S + rest_s + RUN_S,
                run_s=RUN_S,
                queue_s=0.0,
                moved=BYTES,
                bound=True,
                condition=NEAR,
            )
        assert predicted_s(model) == pytest.approx(expected_s, rel=0.03)


def test_noise_of_run_and_network_gives_the_spread() -> None:
    """The spread of a noisy server covers the standard deviation of its times, within a factor of two."""
    rng, model, times = Random(4), Parts(remote=True), []
    for _ in range(200):
        rest_s, slow = rng.uniform(0.5, 1.5) * REST_S, rng.lognormvariate(0, 0.2)
        times.append(RTT_S + rest_s + slow * RUN_S)
        answer(model, rest_s=rest_s, slow=slow)
    mean = sum(times) / len(times)
    true_s = math.sqrt(sum((one - mean) ** 2 for one in times) / len(times))
    found = predict(model, 1.0, moved=BYTES, condition=NEAR)
    assert found is not None
    assert 0.5 * true_s < found.spread_s < 2.0 * true_s


@pytest.mark.parametrize("make", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_knows_everything(make) -> None:  # type: ignore[no-untyped-def]
    """A deep copy and a pickle predict the same, learn the same, and do not share what they learn."""
    model = server()
    answer(model, condition=Condition(round_trip_s=RTT_S, server_load=0.7), slow=2.0)
    twin = make(model)
    loaded = Condition(round_trip_s=RTT_S, queue=1, server_load=0.7)
    for _ in range(3):
        for condition in (NEAR, loaded):
            assert predict(twin, 1.3, moved=BYTES, condition=condition) == predict(
                model, 1.3, moved=BYTES, condition=condition
            )
        answer(model, slow=1.5), answer(twin, slow=1.5)
    assert twin.full
    before = predicted_s(twin)
    answer(model, slow=3.0), answer(model, slow=3.0)
    assert predicted_s(twin) == before


NS = 1e-9  # no clock tells shorter times apart
SECONDS = st.one_of(st.just(0.0), st.floats(NS, 1e6))
NUMBER = st.one_of(st.just(0.0), st.floats(NS, 1e12))
CONDITIONS = st.builds(
    Condition,
    round_trip_s=st.none() | SECONDS,
    queue=st.integers(0, 100),
    load=st.floats(0, 1),
    capacity=st.floats(0.001, 1),
    server_load=st.floats(0, 1),
    queue_s=SECONDS,
)
LEARNED = st.tuples(NUMBER, SECONDS, st.none() | SECONDS, NUMBER, CONDITIONS, st.sampled_from("abc"))


@given(remote=st.booleans(), tasks=st.lists(LEARNED, max_size=30))
def test_no_task_breaks_the_model(
    remote: bool, tasks: list[tuple[float, float, float | None, float, Condition, str]]
) -> None:
    """After zeros, huge numbers and parts that are longer than the whole, every prediction is finite."""
    model = Parts(remote=remote)
    for size, seconds, run_s, moved, condition, way in tasks:
        if way == "c":
            learn(model, size, seconds, ended=False, moved=moved, condition=condition)
        else:
            learn(
                model,
                size,
                seconds,
                run_s=run_s,
                queue_s=run_s,
                moved=moved,
                bound=way == "b",
                condition=condition,
            )
        found = predict(model, size, moved=moved, condition=condition)
        if found is not None:
            assert math.isfinite(found.seconds)
            assert found.seconds >= 0
            assert math.isfinite(found.spread_s or 0.0)


def test_what_a_byte_takes_is_learned_from_tasks_of_different_bytes() -> None:
    """Before the first answer it is that of a usual link; equal tasks allow more than the truth."""
    model = Parts(remote=True)
    assert model.byte_s == 1 / FIRST_BYTES_S
    for _ in range(20):
        answer(model, moved=1e6, rest_s=1e6 / BYTES_S)
    assert model.byte_s > 0.8 / BYTES_S
    for n in range(40):
        moved = 1e6 if n % 2 else 3e5
        answer(model, moved=moved, rest_s=moved / BYTES_S)
    assert model.byte_s == pytest.approx(1 / BYTES_S, rel=0.1)
