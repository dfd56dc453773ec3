"""Whether predictions' intervals held, by hand from records as a trace holds them."""

import numpy as np
import pytest

from offboard.loadgen.scenario.interval_coverage import (
    Interval,
    interval_columns,
    interval_figures,
    intervals_of,
    late_seconds,
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
        (record("cloud", 0.3), [False]),  # within onboard's: its own counts
        (record("edge", 0.3), []),  # it had none
        (record("cloud", 0.5, ok=False, censored=True), [False]),  # longer than the interval, at least
        (record("cloud", 0.1, ok=False, censored=True), []),  # nobody knows
        (record("cloud", 0.1, ok=False), []),  # a failure is no time
    ],
)
def test_an_execution_is_held_to_the_interval_of_its_site(run: dict, held: list[bool]) -> None:
    """Both ends are within; what was given up after the upper end missed it."""
    assert [one.held for one in intervals_of(run, {})] == held


def test_a_late_answer_counts_with_its_true_time() -> None:
    """A run that was overtaken is told by the record that its end was written in."""
    overtaken = record("cloud", 0.01, ok=False, censored=True)
    late = [{"id": "a-1", "site": "cloud", "seconds": 0.09, "ok": True, "censored": False}]
    (found,) = intervals_of(overtaken, late_seconds([overtaken, record("onboard", 0.2, late=late)]))
    assert found.held
    assert (found.width_s, found.error_s) == (pytest.approx(0.05), pytest.approx(-0.01))


def interval(width_s: float, held: bool, *, site: str = "cloud", error_s: float = 0.0) -> Interval:
    return Interval(site, 2.0, width_s, error_s, held)


def test_coverage_and_width_are_of_all_executions_of_the_picked_tasks() -> None:
    """Three times held of four is 75 %; the median width is that of the middle two; nothing is undefined."""
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


def test_a_width_is_compared_with_the_constant_one_of_its_site_that_holds_as_many() -> None:
    """By hand: of the cloud's errors -1, 0, 1, 5 s three were held, and 2 s are enough for three; onboard two
    of 0, 4 s and one that was given up, for which it takes 4 s."""
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
