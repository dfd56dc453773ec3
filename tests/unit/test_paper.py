"""The policy `paper` is Algorithm 1 as published, compared with a literal transcription of it."""

import random
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.common.tasks import task
from offboard.robot_client import policies
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Forecast, Outlook
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner


@task("paper_probe", size=lambda size, onboard_s, cloud_s: size)  # noqa: ARG005 - times are for the runners
def paper_probe(size: float, onboard_s: float, cloud_s: float) -> tuple[float, float, float]:
    return size, onboard_s, cloud_s


Row = tuple[float, float, float]
Queue = list[tuple[Fraction, Fraction]]


def transcription(rows: list[Row], n: int) -> list[tuple[str, Queue, Queue]]:
    """Algorithm 1, line by line, in rational numbers: the decision and both queues after each task."""
    b_l: Queue = []
    b_c: Queue = []
    seen = []
    for d, t_l, t_c in ([Fraction(value) for value in row] for row in rows):
        if len(b_l) < n or len(b_c) < n:
            decision = "both"
            b_l.append((d, t_l))
            b_c.append((d, t_c))
        else:
            p_l, p_c = psi(b_l, d), psi(b_c, d)
            if p_c < p_l:
                decision = CLOUD
                b_c.pop(0)
                b_c.append((d, t_c))
            else:
                decision = ONBOARD
                b_l.pop(0)
                b_l.append((d, t_l))
        seen.append((decision, list(b_l), list(b_c)))
    return seen


def psi(queue: Queue, d: Fraction) -> Fraction:
    mean_d = sum((d_i for d_i, _ in queue), Fraction(0)) / len(queue)
    mean_t = sum((t_i for _, t_i in queue), Fraction(0)) / len(queue)
    bottom = sum(((d_i - mean_d) ** 2 for d_i, _ in queue), Fraction(0))
    if bottom == 0:
        return mean_t
    m = sum(((d_i - mean_d) * (t_i - mean_t) for d_i, t_i in queue), Fraction(0)) / bottom
    c = mean_t - m * mean_d
    return m * d + c


def offloaded(rows: list[Row], n: int) -> list[tuple[str, Queue, Queue]]:
    """The same rows with the real offloader, and runners that take the times of the rows."""
    made: list[LeastSquares] = []

    def remember() -> LeastSquares:
        made.append(LeastSquares(n))
        return made[-1]

    def answer(site: str, column: int) -> ScriptedRunner:
        return ScriptedRunner(site, lambda one: Execution(site, one.args[column], value=one.args))

    seen = []
    # The order of the runners is the order in which their memories are made.
    with Offloader(
        [answer(ONBOARD, 1), answer(CLOUD, 2)], policy=policies.make("paper"), memories=Memories(remember)
    ) as offload:
        for row in rows:
            offload(paper_probe, *row)
            record = offload.last
            assert record is not None
            decision = "both" if record.decision.both else record.decision.site
            b_l, b_c = ([(Fraction(d), Fraction(t)) for d, t in one.window] for one in made)
            seen.append((decision, b_l, b_c))
    return seen


@st.composite
def row_streams(draw: st.DrawFn) -> list[Row]:
    """Rows whose times grow with size; sites cross and tie."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    top = draw(st.sampled_from([5.0, 1e3, 1e7]))
    grain = draw(st.sampled_from([0, 1]))  # whole sizes and tenths of seconds make ties likely
    rows = []
    for _ in range(draw(st.integers(3, 120))):
        d = float(rng.randint(0, 4)) if grain else rng.uniform(0, top)
        t_l, t_c = rng.uniform(0.01, 0.4) + 0.2 * d / top, rng.uniform(0.05, 0.3) + 0.1 * d / top
        rows.append((d, round(t_l, 1), round(t_c, 1)) if grain else (d, t_l, t_c))
    return rows


@given(row_streams(), st.integers(2, 25))
@settings(max_examples=150)
def test_decisions_and_queues_equal_the_transcription(rows: list[Row], n: int) -> None:
    """After every task, the decision and both queues are those of Algorithm 1."""
    wanted, got = transcription(rows, n), offloaded(rows, n)
    for i, ((decision, b_l, b_c), (ours, our_l, our_c)) in enumerate(zip(wanted, got, strict=True)):
        if ours != decision and near_tie(wanted[i - 1], rows[i]):
            return  # rounding broke a tie of the rational numbers: from here on the two differ
        assert (ours, our_l, our_c) == (decision, b_l, b_c), f"task {i}"


def near_tie(before: tuple[str, Queue, Queue], row: Row) -> bool:
    p_l, p_c = psi(before[1], Fraction(row[0])), psi(before[2], Fraction(row[0]))
    return abs(p_l - p_c) <= Fraction(1, 10**12) * max(abs(p_l), abs(p_c))


def outlook(predicted_s: float | None, full: bool = True) -> Outlook:
    return Outlook(predicted_s=predicted_s, full=full)


def test_a_tie_stays_onboard() -> None:
    """Eq. 1: the cloud is chosen only if it is strictly faster."""
    decision = policies.make("paper").decide(
        Forecast(size=1.0, sites={CLOUD: outlook(0.1), ONBOARD: outlook(0.1)})
    )
    assert (decision.site, decision.both) == (ONBOARD, False)


def test_the_smaller_prediction_wins_and_the_reason_shows_both() -> None:
    """The cloud is chosen if its prediction is smaller, and the reason shows both times."""
    decision = policies.make("paper").decide(
        Forecast(size=1.0, sites={CLOUD: outlook(0.0999), ONBOARD: outlook(0.1)})
    )
    assert decision.site == CLOUD
    assert decision.reason == "cloud 99.9 ms against onboard 100 ms"


@pytest.mark.parametrize(("cloud", "onboard"), [(True, False), (False, True), (False, False)])
def test_both_sites_run_until_both_windows_are_full(cloud: bool, onboard: bool) -> None:
    """The warm-up lasts while one of the queues has fewer than N observations."""
    forecast = Forecast(size=1.0, sites={CLOUD: outlook(0.1, cloud), ONBOARD: outlook(0.2, onboard)})
    assert policies.make("paper").decide(forecast).both


def test_the_rule_chooses_the_fastest_of_three_sites() -> None:
    """With more servers, the smallest prediction of all sites wins."""
    sites = {CLOUD: outlook(0.3), "edge": outlook(0.1), ONBOARD: outlook(0.2)}
    assert policies.make("paper").decide(Forecast(size=1.0, sites=sites)).site == "edge"


@pytest.mark.parametrize("site", [ONBOARD, CLOUD])
def test_a_constant_policy_always_chooses_its_site(site: str) -> None:
    """The policies `onboard` and `cloud` ignore the predictions."""
    forecast = Forecast(size=1.0, sites={CLOUD: outlook(0.9), ONBOARD: outlook(0.1)})
    assert policies.make(site).decide(forecast).site == site
    assert not policies.make(site).decide(forecast).both


def test_an_unknown_policy_names_the_known_ones() -> None:
    """The error for a misspelt name lists all rules."""
    with pytest.raises(ConfigError, match="'papr' is not one of paper, "):
        policies.make("papr")
