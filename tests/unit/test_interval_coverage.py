"""Coverage and width of prediction intervals, computed by hand from trace records."""

import numpy as np
import pytest

from offboard.loadgen.robot_files import late_executions
from offboard.loadgen.scenario.interval_coverage import (
    Interval,
    interval_columns,
    interval_figures,
    intervals_of,
)

SITES = {
    "onboard": {"predicted_s": 0.2, "low_s": 0.1, "high_s": 0.4},
    "cloud": {"predicted_s": 0.1, "low_s": 0.08, "high_s": 0.13},
    "edge": {"predicted_s": None, "low_s": None, "high_s": None},
}


def record(site: str, seconds: float, *, ok: bool = True, censored: bool = False, **more: object) -> dict:
    run = {"site": site, "seconds": seconds, "ok": ok, "censored": censored}
    return {"id": "a-1", "sites": SITES, "executions": [run], **more}


@pytest.mark.parametrize(
    ("run", "held"),
    [
        (record("onboard", 0.3), [True]),
        (record("onboard", 0.4), [True]),
        (record("onboard", 0.05), [False]),
        (record("cloud", 0.3), [False]),  # within the interval of onboard, but its own counts
        (record("edge", 0.3), []),  # the site had no interval
        (record("cloud", 0.5, ok=False, censored=True), [False]),  # certainly longer than the interval
        (record("cloud", 0.1, ok=False, censored=True), []),  # its true time is unknown
        (record("cloud", 0.1, ok=False), []),  # a failed execution has no time
    ],
)
def test_a_time_is_compared_with_the_interval_of_its_own_site(run: dict, held: list[bool]) -> None:
    """Both ends belong to the interval; an execution given up after the upper end is a miss."""
    assert [one.held for one in intervals_of(run, {})] == held


def test_a_late_execution_counts_with_its_true_time() -> None:
    """An overtaken execution counts with the time that a later record reports for it."""
    overtaken = record("cloud", 0.01, ok=False, censored=True)
    late = [{"id": "a-1", "site": "cloud", "seconds": 0.09, "ok": True, "censored": False}]
    (found,) = intervals_of(overtaken, late_executions([overtaken, record("onboard", 0.2, late=late)]))
    assert found.held
    assert (found.width_s, found.error_s) == (pytest.approx(0.05), pytest.approx(-0.01))


def interval(width_s: float, held: bool, *, site: str = "cloud", error_s: float = 0.0) -> Interval:
    return Interval(site, 2.0, width_s, error_s, held)


def test_coverage_and_width_are_over_all_executions_of_the_picked_tasks() -> None:
    """Three of four times within the interval are 75 %; without executions the figures are undefined."""
    tasks = [
        (interval(2.0, True), interval(8.0, False)),
        (),
        (interval(4.0, True),),
        (interval(6.0, True),),
    ]
    found = interval_figures(interval_columns(tasks), np.array([[0, 1, 2, 3], [1, 1, 1, 1], [2, 2, 3, 1]]))
    assert found["coverage_percent"] == pytest.approx([75.0, np.nan, 100.0], nan_ok=True)
    assert found["relative_width"] == pytest.approx([2.5, np.nan, 2.0], nan_ok=True)
    nothing = interval_figures(interval_columns([(), ()]), np.array([[0, 1]]))
    assert all(np.isnan(figure).all() for figure in nothing.values())


def test_a_width_is_compared_with_the_best_constant_width_of_its_site() -> None:
    """The best constant interval is 2 s wide for the cloud and 4 s onboard.

    Cloud: three of the errors -1, 0, 1 and 5 s were within the interval, and 2 s contain three of them.
    Onboard: two of 0 s, 4 s and one that was given up were within it, and 4 s contain two of them.
    """
    cloud = [(interval(3.0, held, error_s=error_s),) for error_s, held in ((-1, 1), (0, 1), (1, 1), (5, 0))]
    onboard = [
        (interval(8.0, held, site="onboard", error_s=error_s),)
        for error_s, held in ((0, True), (4, True), (np.inf, False))
    ]
    columns = interval_columns(cloud + onboard)
    found = interval_figures(columns, np.array([[0, 1, 2, 3], [3, 2, 1, 0]]))
    assert found["width_over_constant"] == pytest.approx([1.5, 1.5])
    assert interval_figures(columns, np.array([[4, 5, 6]]))["width_over_constant"] == pytest.approx([2.0])
    assert interval_figures(columns, np.arange(7)[None])["width_over_constant"] == pytest.approx([1.5])
