"""The numbers in the charts of a report, computed by hand."""

from pathlib import Path

import numpy as np
import pytest

from offboard.loadgen.report import chart_data
from offboard.loadgen.table.measured_rows import Rows, read
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two import Evaluation
from tests.reports import write_rows
from tests.table_loops import THOUSAND

SIZES = [0.0, 1.0, 2.0, 3.0]


def rows_of(onboard_s: list[float], cloud_s: list[float], sizes: list[float] = SIZES) -> Rows:
    return Rows(np.array(sizes), np.array(onboard_s), np.array(cloud_s))


def test_lines_and_their_crossing_by_hand() -> None:
    """For d = 0..3, sum (d - 1.5)^2 = 5: slopes 3/5 and 1/5 through means 2 and 2.2 cross at 1.5 + 0.5."""
    found = chart_data.times(rows_of([1, 2, 2, 3], [2.2, 1.2, 3.2, 2.2]), seed=1)
    assert (found.onboard.slope, found.cloud.slope) == pytest.approx((0.6, 0.2))
    assert (found.onboard.at(0.0), found.cloud.at(3.0)) == pytest.approx((1.1, 2.5))
    assert found.crossing == pytest.approx(2.0)
    assert found.crossing_inside
    assert (found.low, found.high) == (0, 3)


def test_distribution_by_hand() -> None:
    """Of the times 3, 1, 2, 2 a quarter is at most 1, three quarters are at most 2, and all are at most 3."""
    seconds, percent = chart_data.ecdf(np.array([3.0, 1.0, 2.0, 2.0]))
    assert seconds.tolist() == [1, 1, 2, 2, 3]
    assert percent.tolist() == [0, 25, 50, 75, 100]


def test_a_long_distribution_is_thinned_and_keeps_its_ends() -> None:
    """Of 12,345 times POINTS_MAX steps are drawn, each at its exact place."""
    seconds, percent = chart_data.ecdf(np.random.default_rng(3).permutation(12_345).astype(np.float64))
    assert len(seconds) == chart_data.POINTS_MAX + 1
    assert (seconds[0], seconds[-1], percent[-1]) == (0, 12_344, 100)
    np.testing.assert_allclose(percent[1:], 100 * (seconds[1:] + 1) / 12_345)


def test_points_are_thinned_evenly_and_by_seed() -> None:
    """One point is drawn from each of POINTS_MAX equal parts, in order; the same ones for the same seed."""
    assert chart_data.thin(chart_data.POINTS_MAX, 1).tolist() == list(range(chart_data.POINTS_MAX))
    picks = chart_data.thin(100_000, 1)
    assert (picks // 100).tolist() == list(range(chart_data.POINTS_MAX))
    assert picks.tolist() == chart_data.thin(100_000, 1).tolist() != chart_data.thin(100_000, 2).tolist()
    assert len(set(chart_data.thin(chart_data.POINTS_MAX + 1, 1))) == chart_data.POINTS_MAX


def test_accuracy_intervals_match_the_table(tmp_path: Path) -> None:
    """The intervals in the chart are those that `loadgen table --bootstrap` prints."""
    rows = read(write_rows(tmp_path, THOUSAND[:400]))
    config = TableConfig(windows=("5", "50", "full"), bootstrap=True, seed=4)
    lines = [line for line in Evaluation(rows, config).scores("chosen") if line.predictor]
    expected = [(line.window, line.accuracy_percent) for line in lines if line.bound]

    def ends(seed: int) -> list[tuple[str, float]]:
        plain = [line for line in lines if not line.bound]
        found = chart_data.accuracy_intervals(Evaluation(rows, TableConfig()), plain, "chosen", seed)
        return [(window, end) for window, one in found.items() for end in (one.low, one.high)]

    assert ends(4) == expected
    assert ends(1) != expected
