"""Jitter: correlation that keeps the distribution, measured delays, and draws that belong to a segment."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from offboard.common.errors import DataError
from offboard.loadgen.relay.link.draws import (
    DISTRIBUTIONS,
    PARETO_SD,
    PARETO_SHAPE,
    REPLAY_MAX,
    Draws,
    Jitter,
    quantile,
    replay_from,
)
from offboard.loadgen.relay.link.link import SAMPLES_MAX
from offboard.loadgen.relay.link.recording_file import read_samples

SEEDS = st.integers(0, 2**32)
CORRELATION = 0.6
APART = 40  # 0.6^40 is 1e-9: so far apart, correlated draws are independent
COUNT = 4000

# What each named distribution is, from scipy, in units of jitter_ms.
THEORY = {
    "uniform": scipy.stats.uniform(-1, 2),
    "normal": scipy.stats.norm(),
    "pareto": scipy.stats.lomax(PARETO_SHAPE, scale=1 / PARETO_SD),
    "lognormal": scipy.stats.lognorm(1, scale=1 / math.sqrt((math.e - 1) * math.e)),
}


@pytest.mark.parametrize("distribution", THEORY)
def test_correlation_keeps_the_distribution(distribution: str) -> None:
    """Every 40th correlated draw passes the Kolmogorov-Smirnov test against the named distribution."""
    jitter = Jitter("7/1/up")
    drawn = [DISTRIBUTIONS[distribution](jitter.at(n, CORRELATION)) for n in range(APART * COUNT)]
    p = scipy.stats.kstest(drawn[::APART], THEORY[distribution].cdf).pvalue
    print(f"p = {p:.3f}")
    assert p > 0.001


@pytest.mark.parametrize("correlation", [0.1, 0.5, 0.9])
def test_neighbours_have_the_requested_correlation(correlation: float) -> None:
    """Normal scores at distance k correlate by correlation^k, within four standard errors (Bartlett)."""
    jitter = Jitter("3/1/up")
    scores = scipy.stats.norm.ppf([jitter.at(n, correlation) for n in range(20_000)])
    spread = math.sqrt((1 + correlation**2) / (1 - correlation**2) / len(scores))
    for lag in (1, 2):
        found = np.corrcoef(scores[:-lag], scores[lag:])[0, 1]
        print(f"lag {lag}: {found:.4f}")
        assert found == pytest.approx(correlation**lag, abs=4 * spread)


def test_full_correlation_is_one_draw() -> None:
    """At correlation 1 every segment has the draw of the first segment."""
    jitter = Jitter("1/1/up")
    assert len({jitter.at(n, 1) for n in range(100)}) == 1
    assert jitter.at(100, 1) == Jitter("1/1/up").at(0)


@given(seed=SEEDS, asked=st.lists(st.tuples(st.integers(0, 3000), st.sampled_from([0, 0.3, 0.95, 1]))))
def test_a_draw_belongs_to_its_segment(seed: int, asked: list[tuple[int, float]]) -> None:
    """The draw of a segment does not depend on earlier questions, or on their correlation."""
    used = Jitter(f"{seed}/1/up")
    for number, correlation in asked:
        used.at(number, correlation)
    for correlation in (0, 0.3, 0.95):
        fresh = Jitter(f"{seed}/1/up")
        whole = [fresh.at(n, correlation) for n in range(1500)]
        assert used.at(1499, correlation) == pytest.approx(whole[-1], abs=1e-9)


@given(seed=SEEDS, number=st.integers(0, 200_000))
def test_skipped_draws_change_nothing(seed: int, number: int) -> None:
    """A segment far ahead has the same draw as if all segments before it had been drawn."""
    ahead, one_by_one = Draws(str(seed)), Draws(str(seed))
    for n in range(number % 1000):
        one_by_one.at(n)
    assert ahead.at(number) == one_by_one.at(number)


def test_a_replay_is_bounded() -> None:
    """A replay starts where earlier segments are below the rounding error, at most REPLAY_MAX back."""
    assert replay_from(1_000_000, 0) == 1_000_000
    assert replay_from(1_000_000, 0.5) == 1_000_000 - 53
    assert replay_from(1_000_000, 1 - 1e-12) == 1_000_000 - REPLAY_MAX
    assert replay_from(10, 0.9) == 0


def test_samples_are_drawn_equally_often(tmp_path: Path) -> None:
    """Each delay of a file is drawn equally often (chi-square test over the values)."""
    file = tmp_path / "delays"
    file.write_text("30\n5.5\n\n12\n5.5\n")
    samples = read_samples(file)
    assert samples == (5.5, 5.5, 12.0, 30.0)
    jitter = Jitter("5/1/up")
    drawn = [quantile(samples, jitter.at(n)) for n in range(COUNT)]
    counts = [drawn.count(value) for value in (5.5, 12.0, 30.0)]
    p = scipy.stats.chisquare(counts, [COUNT / 2, COUNT / 4, COUNT / 4]).pvalue
    print(f"counts {counts}, p = {p:.3f}")
    assert p > 0.001
    assert quantile(samples, 1 - 2**-53) == 30.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\nabc\n", ":2: 'abc' is not a delay in ms from 0 to 60000"),
        ("1\n2\n-3\n", ":3: '-3' is not a delay in ms from 0 to 60000"),
        ("nan", ":1: 'nan' is not a delay in ms from 0 to 60000"),
        ("60001", ":1: '60001' is not a delay in ms from 0 to 60000"),
        ("\n \n", ": the file holds no delays"),
        ("1\n" * (SAMPLES_MAX + 1), f":{SAMPLES_MAX + 1}: '1' is one delay too many; at most {SAMPLES_MAX}"),
    ],
)
def test_a_bad_file_of_samples_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    """A file that is not a list of delays is refused; the error names file, line and value."""
    file = tmp_path / "delays"
    file.write_text(text)
    with pytest.raises(DataError) as caught:
        read_samples(file)
    assert str(caught.value).startswith(f"{file}{message}")
    assert "\n" not in str(caught.value)


def test_a_missing_file_of_samples_is_named(tmp_path: Path) -> None:
    """The error names a file that does not exist."""
    with pytest.raises(DataError, match="nowhere: No such file or directory"):
        read_samples(tmp_path / "nowhere")
