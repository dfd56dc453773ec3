"""The line of one part of a task: it is found, outliers move it little, and changes are followed."""

import math
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.robot_client.predictors.line import ODD, TAIL_MAX, Line, RunningMean


def taught(
    *, together: bool = True, noise: float = 0.0, times: int = 40, a: float = 0.1, b: float = 0.3
) -> Line:
    """A line that has learned times of `a + b x` with this share of noise."""
    rng, line = Random(1), Line(together=together)
    for _ in range(times):
        x = rng.uniform(0.5, 2.0)
        line.learn(x, (a + b * x) * rng.lognormvariate(0.0, noise))
    return line


def news(line: Line, factor: float, times: int = 1, *, x: float = 1.0) -> None:
    """Times of an amount that differ from the line by a factor."""
    true_s = factor * line.at(x)
    for _ in range(times):
        line.learn(x, true_s)


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize(("a", "b"), [(0.1, 0.3), (0.0, 0.5), (0.2, 0.0), (20.0, 5.0)])
def test_a_line_through_exact_times_is_found(together: bool, a: float, b: float) -> None:
    """After 40 times of different amounts, the line is right to 2 % for small and large amounts."""
    line = taught(together=together, a=a, b=b)
    for x in (0.5, 1.0, 2.0):
        assert line.at(x) == pytest.approx(a + b * x, rel=0.02)
    assert line.deviation < 0.1
    assert line.count == 40


@pytest.mark.parametrize("together", [True, False])
def test_noisy_times_are_averaged(together: bool) -> None:
    """With 20 % of noise the line is right to 10 %, and it knows the deviation of the times."""
    line = taught(together=together, noise=0.2, times=200)
    for x in (0.5, 1.0, 2.0):
        assert line.at(x) == pytest.approx(0.1 + 0.3 * x, rel=0.1)
    assert line.deviation == pytest.approx(0.2, rel=0.4)


def test_the_first_time_is_predicted_for_its_own_amount() -> None:
    """One time already gives a line: half of the time counts as proportional to the amount."""
    line = Line(together=True)
    line.learn(1.0, 0.4)
    assert line.at(1.0) == pytest.approx(0.4)
    assert line.at(3.0) == pytest.approx(0.8)


def test_one_outlier_moves_the_line_little() -> None:
    """A time of ten times the usual one moves the line by less than 10 %, and tasks of the same time as
    before bring it back.
    """
    line = taught(noise=0.05)
    before_s = line.at(1.0)
    news(line, 10.0)
    assert line.at(1.0) < 1.1 * before_s
    for _ in range(10):
        line.learn(1.0, before_s)
    assert line.at(1.0) == pytest.approx(before_s, rel=0.03)


def test_two_outliers_on_one_side_are_a_change() -> None:
    """The second slow time in a row is believed for a large part, though it about doubles the line at most.

    Otherwise two stalls of seconds keep a robot away from a server for as long as nobody asks it.
    """
    line = taught(noise=0.05)
    before_s = line.at(1.0)
    news(line, 1.8, times=2)
    assert line.at(1.0) > 1.5 * before_s
    far = taught(noise=0.05)
    news(far, 10.0, times=2)
    assert before_s * 1.5 < far.at(1.0) < before_s * 2.2
    news(far, 10.0 * before_s / far.at(1.0), times=6)
    assert far.at(1.0) == pytest.approx(10.0 * before_s, rel=0.1)


def test_outliers_with_an_expected_time_between_them_are_no_change() -> None:
    """Every second time is five times as long; the line stays, and `tail` says what they add in the mean."""
    line = taught(noise=0.05)
    before_s = line.at(1.0)
    for _ in range(30):
        line.learn(1.0, 5.0 * before_s)
        line.learn(1.0, before_s)
    assert line.at(1.0) < 2.0 * before_s
    assert 0.2 < line.tail <= TAIL_MAX


def test_a_shorter_time_is_believed_at_once() -> None:
    """A single time far below the line lowers it for the most part: no site answers too early by chance."""
    line = taught(noise=0.05)
    before_s = line.at(1.0)
    line.learn(1.0, 0.3 * before_s)
    assert line.at(1.0) < 0.5 * before_s


def test_a_slow_change_is_followed_for_thousands_of_tasks() -> None:
    """A site becomes slower by 0.03 % a task, which no single time shows; the line stays within 6 %."""
    rng, line = Random(1), Line(together=True)
    for n in range(3000):
        x, slower = rng.uniform(0.3, 2.0), 1.0003**n
        line.learn(x, (0.1 + 0.2 * x) * slower * rng.lognormvariate(0.0, 0.1))
    assert line.at(1.0) == pytest.approx(0.3 * 1.0003**3000, rel=0.06)


def test_a_slower_computer_is_slower_for_all_amounts() -> None:
    """With `together`, small tasks of twice the usual time double the prediction of large ones."""
    line = taught(noise=0.02)
    large_s = line.at(2.0)
    true_s = 2.0 * line.at(0.5)
    for _ in range(8):
        line.learn(0.5, true_s)
    assert line.at(2.0) == pytest.approx(2.0 * large_s, rel=0.15)


def test_a_change_of_bandwidth_leaves_the_delay() -> None:
    """Without `together`, large payloads of a slower link do not raise the prediction of small ones much."""
    rng, line = Random(2), Line(together=False)
    delay_s = 0.05

    def send(share: float, low: float, high: float) -> None:
        for _ in range(40):
            x = rng.uniform(low, high)
            line.learn(x, delay_s + share * x, apart_s=0.03)

    send(0.2, 0.01, 2.0)
    send(0.8, 0.5, 2.0)
    assert line.at(2.0) == pytest.approx(delay_s + 1.6, rel=0.05)
    assert line.at(0.0) == pytest.approx(delay_s, abs=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_a_recovered_bandwidth_is_known_for_large_payloads_after_a_few_small_ones(seed: int) -> None:
    """The link falls to a tenth for three answers and recovers; five small payloads then tell the slope."""
    rng, line = Random(seed), Line(together=False)

    def answer(x: float, slope: float) -> None:
        line.learn(x, slope * x * rng.lognormvariate(0.0, 0.1), 0.04)

    for _ in range(30):
        answer(rng.uniform(0.1, 1.0), 0.16)
    for x in (0.5, 0.3, 0.4):
        answer(x, 1.6)
    assert line.at(1.0) > 0.36
    for _ in range(5):
        answer(rng.uniform(0.1, 0.3), 0.16)
    assert 0.08 < line.at(1.0) < 0.36  # it was more before
    assert line.a >= 0.0


@given(
    times=st.lists(st.tuples(st.floats(0, 5), st.floats(0, 5)), max_size=20),
    bound=st.tuples(st.floats(0, 5), st.floats(0, 5), st.floats(0, 1)),
)
def test_a_bound_never_raises_a_line(
    times: list[tuple[float, float]], bound: tuple[float, float, float]
) -> None:
    """A task took at most this long: the line is at most this long there, and nowhere longer than before."""
    line = Line(together=False)
    line.learn(1.0, 1.0)
    for x, y in times:
        line.learn(x, y)
    places = (0.0, 1.0, 4.0, bound[0])
    before = [line.at(x) for x in places]
    line.bound(*bound)
    after = [line.at(x) for x in places]
    assert all(new <= old for new, old in zip(after, before, strict=True))
    assert line.at(bound[0]) <= bound[1] + 1e-9


def test_a_bound_is_all_that_an_empty_line_knows() -> None:
    """Before the first time, the bound counts as a time; a shorter time moves it."""
    line = Line(together=False)
    line.bound(1.0, 0.4, 0.0)
    assert line.at(1.0) == pytest.approx(0.4)
    line.learn(1.0, 0.1)
    assert line.at(1.0) < 0.36


def test_a_link_much_faster_than_one_answer_says_is_known_after_the_next() -> None:
    """Half of a first time of 40 ms is put down to its amount; a far larger amount corrects it at once."""
    line = Line(together=False)
    line.learn(1.0, 0.04)
    assert line.at(750.0) == pytest.approx(15.0, rel=0.01)
    line.learn(750.0, 0.04 + 8e-4 * 750.0)
    assert line.at(500.0) == pytest.approx(0.44, rel=0.15)


def test_times_that_begin_to_vary_are_noise_again() -> None:
    """After 1,000 equal times, 200 times that vary by 10 % are seen as noise, not as 200 changes."""
    rng, line = Random(1), Line(together=True)
    for _ in range(1000):
        line.learn(1.0, 0.25)
    for _ in range(200):
        line.learn(1.0, 0.25 * rng.lognormvariate(0.0, 0.1))
    assert line.deviation > 0.05
    assert line.at(1.0) == pytest.approx(0.25, rel=0.05)


NS = 1e-9  # no clock tells shorter times apart
SECONDS = st.one_of(st.just(0.0), st.floats(NS, 10), st.floats(NS, 1e9))
AMOUNT = st.one_of(st.just(0.0), st.floats(NS, 10), st.floats(NS, 1e12))
ANY = st.tuples(AMOUNT, SECONDS, SECONDS)


@given(together=st.booleans(), times=st.lists(ANY, max_size=40), bound=st.integers(0, 5))
def test_no_time_breaks_a_line(together: bool, times: list[tuple[float, float, float]], bound: int) -> None:
    """After zeros, equal times and huge numbers, everything is a finite number of seconds from 0 on."""
    line = Line(together=together)
    for n, (x, y, known) in enumerate(times):
        if bound and n % bound == 0:
            line.bound(x, y, known)
        else:
            line.learn(x, y, known)
        for at in (0.0, 1.0, x, 1e12):
            assert math.isfinite(line.at(at))
            assert line.at(at) >= 0
        assert 0 <= line.tail <= TAIL_MAX
        assert math.isfinite(line.deviation)


@pytest.mark.parametrize("seconds", [0.0, 0.25])
def test_equal_times_are_predicted_exactly(seconds: float) -> None:
    """A thousand equal times give their own value, with almost no spread and no tail."""
    line = Line(together=True)
    for _ in range(1000):
        line.learn(1.0, seconds)
    assert line.at(1.0) == pytest.approx(seconds)
    assert line.deviation < 1.0 / ODD
    assert line.tail == pytest.approx(0.0, abs=1e-6)


def test_a_running_mean_is_plain_at_first_and_forgets_later() -> None:
    """Three values give their mean; after a hundred new ones, the old ones hardly count."""
    mean = RunningMean()
    for one in (1.0, 2.0, 6.0):
        mean.add(one)
    assert mean.value == pytest.approx(3.0)
    for _ in range(100):
        mean.add(10.0)
    assert mean.value == pytest.approx(10.0, rel=0.01)
