"""Claim 1: the p-value of Pearson's r, and which windows are significant."""

import numpy as np
import pytest
from scipy import stats

from offboard.loadgen.claims.claim import ClaimsConfig
from offboard.loadgen.claims.correlation_claims import P_MAX, p_value, significance, smallest_significant_r
from offboard.loadgen.table.measured_rows import Rows


def test_known_p_values() -> None:
    """That of scipy's own test of r; three rows: p is an arctangent; two rows say nothing."""
    size, seconds = np.random.default_rng(5).normal(size=(2, 40))
    tested = stats.pearsonr(size, seconds)
    assert p_value(tested.statistic, 40) == pytest.approx(tested.pvalue, rel=1e-9)
    assert p_value(np.sqrt(0.5), 3) == pytest.approx(0.5, rel=1e-12)  # t = 1
    assert p_value(1.0, 2) == 1.0


@pytest.mark.parametrize("rows", [5, 50, 500])
def test_the_smallest_significant_r_has_that_p_value(rows: int) -> None:
    """r is significant from there on."""
    r = smallest_significant_r(rows)
    assert p_value(r, rows) == pytest.approx(P_MAX, rel=1e-6)
    assert p_value(r - 1e-6, rows) > P_MAX


def test_a_line_is_significant_and_noise_is_not() -> None:
    """Times on a line agree with the paper at every N, and times that are only noise do not."""
    random = np.random.default_rng(4)
    size = random.uniform(0, 5, 300)
    rows = Rows(size, onboard_s=0.1 + size + random.normal(0, 0.1, 300), cloud_s=random.uniform(1, 2, 300))
    config = ClaimsConfig(windows=("10", "50"), predictors=("least-squares",))
    agreed = {one.claim: one.agrees for one in significance(rows, config)}
    assert {agreed[words] for words in agreed if words.startswith("onboard")} == {"yes"}
    assert agreed["cloud: p of r, all rows"] == "no"
    assert agreed["cloud: N = 50, % with p < 0.005"] == "no"


def test_a_falling_line_and_two_points_support_nothing() -> None:
    """A significantly negative r is against the claim, and two points always lie on a line."""
    size = np.random.default_rng(4).uniform(0, 5, 300)
    rows = Rows(size, onboard_s=0.1 + size, cloud_s=9.0 - size)
    config = ClaimsConfig(windows=("2", "10"), predictors=("least-squares",))
    found = {one.claim: one for one in significance(rows, config)}
    assert found["onboard: N = 10, % with p < 0.005"].ours == pytest.approx(100.0)
    assert found["cloud: N = 10, % with p < 0.005"].ours == pytest.approx(0.0)
    for site in ("onboard", "cloud"):
        line = found[f"{site}: N = 2, % with p < 0.005"]
        assert (line.ours, line.note) == (None, "too few rows for a test")


def test_equal_sizes_have_no_correlation() -> None:
    """A dataset with one size only, and one that is shorter than the window, get lines without figures."""
    rows = Rows(np.ones(40), onboard_s=np.arange(40.0), cloud_s=np.arange(40.0))
    found = list(significance(rows, ClaimsConfig(windows=("10", "50"), predictors=("least-squares",))))
    assert {one.ours for one in found} == {None}
    assert {one.note for one in found} == {"too few different rows", "not enough rows"}
