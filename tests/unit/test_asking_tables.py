"""Figures of `benchmarks.asking` from hand-made lines, and what the command does without libraries."""

import math
import subprocess
import sys
from random import Random
from typing import Any

import pytest

from benchmarks.asking_tables import (
    WARM_UP_TASKS,
    calibration_error,
    chance_error,
    coverage,
    expectation_table,
    group_table,
    savings_table,
    true_saving_ms,
)


def line(took_s: float | None, *, in_time: float | None = 0.5, met: bool = True) -> dict[str, Any]:
    """A call whose time was expected to be 1 s, between 0.8 and 1.4 s."""
    return {
        "site": "cloud",
        "seconds": 1.0,
        "interval": [0.8, 1.4],
        "in_time": in_time,
        "took_s": took_s,
        "met": met,
    }


def observed(tasks: int, saved_ms: float, savings: dict[str, Any] | None) -> list[dict[str, Any]]:
    warm = {"observed_s": 9.0, "sent_s": 0.0, "used": "onboard", "savings": None}
    rest = [
        {
            "observed_s": 0.5,
            "sent_s": 0.5 - 1e-3 * (saved_ms + n % 3 - 1),
            "used": "cloud",
            "savings": savings,
        }
        for n in range(tasks)
    ]
    return [warm] * WARM_UP_TASKS + rest


def test_coverage_counts_answered_calls_with_an_interval() -> None:
    """Both ends belong to the interval; a call without a time or an interval does not count."""
    lines = [line(0.8), line(1.4), line(1.5), line(0.1), line(None), line(9.0) | {"interval": None}]
    assert coverage(lines) == 50.0
    assert math.isnan(coverage([line(None)]))


def test_the_calibration_error_is_the_mean_distance_of_five_groups() -> None:
    """Calls of one group have neighbouring probabilities; unknown probabilities are left out."""
    lines = [
        line(1.0, in_time=chance, met=number < met)
        for chance, met in ((0.1, 1), (0.3, 3), (0.5, 10), (0.7, 7), (0.9, 9))
        for number in range(10)
    ]
    assert calibration_error([*lines, line(1.0, in_time=None)]) == pytest.approx(10.0)


def test_chance_alone_causes_an_error() -> None:
    """A perfect prediction of few calls has one, and it falls with the number of calls."""
    random = Random(1)
    told = [(random.random(), True) for _ in range(2_000)]
    few, many = chance_error(told[:200]), chance_error(told)
    assert 3.0 < few < 7.0
    assert many == pytest.approx(few / math.sqrt(10), rel=0.2)


def test_the_table_judges_all_calls_together() -> None:
    """It has a row for each application and site, one for all, and the limits of the issue."""
    runs = {"arm": [line(1.0, in_time=0.9)] * 300, "signs": [line(1.0, in_time=0.9, met=False)] * 30}
    table = expectation_table(runs)
    assert [row[:3] for row in table.rows] == [
        ["arm", "cloud", "300"],
        ["signs", "cloud", "30"],
        ["all", "all", "330"],
    ]
    assert [one.holds for one in table.requirements] == [False, True, False, False]
    assert [row[1] for row in group_table(runs).rows] == ["90.0"] * 5


def test_the_true_saving_is_that_of_the_tasks_after_the_warm_up() -> None:
    """It has an interval, and must lie in the interval of the estimate."""
    lines = observed(
        60, 20.0, {"mean_s": 0.02, "low_s": 0.015, "high_s": 0.03, "tasks": 60, "sent": 1.0, "probes": 8}
    )
    mean_ms, half_ms = true_saving_ms(lines)
    assert mean_ms == pytest.approx(20.0)
    assert half_ms == pytest.approx(1.645 * math.sqrt(2 / 3) / math.sqrt(60), rel=0.02)
    table = savings_table({"arm": lines, "signs": observed(60, 20.0, None)})
    assert table.rows[0] == ["arm", "60", "8", "20.0 [15.0, 30.0]", "20.0 [19.8, 20.2]", "100", "100"]
    assert table.rows[1][3] == "unknown"
    assert [one.holds for one in table.requirements] == [True, True, False]


def test_an_unknown_application_is_one_line() -> None:
    """A wrong name gives exit code 2 and a line with the known names."""
    command = [sys.executable, "-m", "benchmarks.asking", "sings"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr == "python -m benchmarks.asking: unknown application 'sings'; did you mean 'signs'?\n"
