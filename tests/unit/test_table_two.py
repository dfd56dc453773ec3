"""The figures of `loadgen table`, compared with plain loops."""

import json
import math
from collections.abc import Callable
from fractions import Fraction

import pytest

from offboard.loadgen.table.table_settings import PAPER_WINDOWS
from tests.table_loops import (
    THOUSAND,
    TWELVE,
    UNDEFINED,
    constant_line,
    correlations,
    expected_table,
    lines_of,
    printed,
)

Print = Callable[..., str]


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_every_column_equals_plain_loops(print_table: Print, feedback: str) -> None:
    """Every printed digit equals an independent computation, for every N of the paper and for full."""
    found = lines_of(print_table(THOUSAND, feedback=feedback))
    assert found == expected_table(THOUSAND, PAPER_WINDOWS, feedback)


def test_the_lines_of_the_paper_stand_below_ours(print_table: Print) -> None:
    """Below the interval of the same N, as they were printed; an N that the paper has not gets none."""
    printed_json = print_table(THOUSAND, windows=("7", "50"), published=True, bootstrap=True, format="json")
    lines = json.loads(printed_json)["tables"][0]["scores"]
    named = [(one["predictor"], one["window"], one["bound"]) for one in lines if one["predictor"]]
    assert [one for one in named if one[1] == "7"] == [
        ("least-squares", "7", b) for b in ("", "2.5 %", "97.5 %")
    ]
    assert named[-1] == ("the paper", "50", "")
    assert next(one for one in lines if one["predictor"] == "the paper")["accuracy_percent"] == 78.8


def test_only_chosen_feedback_keeps_a_stale_window(print_table: Print) -> None:
    """If the cloud is slow only in warm-up, chosen feedback never tries it again; full feedback soon does."""
    rows = [(1.0 + i % 2, 5.0, 9.0 if i < 2 else 1.0) for i in range(10)]
    chosen, full = (
        lines_of(print_table(rows, windows=("2",), feedback=mode))[0] for mode in ("chosen", "full")
    )
    # Cloud residual, accuracy, regret, cloud share. Full feedback has seen a fast cloud after rows 3 and 4.
    assert [chosen[i] for i in (5, 9, 18, 20)] == ["8.00000", "0.00", "32.00000", "0.00"]
    assert [full[i] for i in (5, 9, 18, 20)] == ["2.00000", "75.00", "8.00000", "75.00"]


def test_overestimates_stay_with_chosen_feedback(print_table: Print) -> None:
    """As in Table II at N = 5, residuals are positive with chosen feedback and near 0 with full feedback."""
    out = json.loads(print_table(THOUSAND, windows=("5",), feedback="both", format="json"))
    chosen, full = (one["scores"][0] for one in out["tables"])
    for residual in ("cloud_residual_s", "onboard_residual_s"):
        assert chosen[residual] > 5 * abs(full[residual])


def test_a_window_without_rows_to_score_says_so(print_table: Print) -> None:
    """A window as long as the table leaves no row to score: its line says so, and the table goes on."""
    lines = lines_of(print_table(TWELVE, windows=("11", "12", "500")))
    assert lines[0][0] == "11"
    assert lines[0][10] == "1"
    assert [line[0] for line in lines[1:3]] == ["12: not enough rows", "500: not enough rows"]
    assert set(lines[1][1:]) == {UNDEFINED, "0"}


@pytest.mark.parametrize("count", [1, 2])
def test_a_tiny_table_has_no_line_for_full(print_table: Print, count: int) -> None:
    """Two rows cannot be split into two to learn and one to score.

    The constant rules still have their lines.
    """
    lines = lines_of(print_table([(1.0, 2.0, 1.0)] * count, windows=("full",)))
    assert lines[0][0] == "full: not enough rows"
    assert lines[1] == constant_line([(1.0, 2.0, 1.0)] * count, "always-onboard", [False] * count)


def test_constant_columns_have_no_correlation(print_table: Print) -> None:
    """Equal sizes or equal times give an undefined r, even if their mean is rounded; it is null in JSON."""
    equal_sizes = [(3.0, 0.1 * i, 0.2) for i in range(1, 8)]
    assert lines_of(print_table(equal_sizes, windows=("3", "full")))[0][1:3] == [UNDEFINED, UNDEFINED]
    equal_times = [(float(i), 0.1, 0.1 * i) for i in range(1, 8)]
    assert lines_of(print_table(equal_times, windows=("3", "full")))[1][1:3] == ["1.00000", UNDEFINED]
    (one,) = json.loads(print_table(equal_times, windows=("3",), format="json"))["tables"]
    assert one["scores"][0]["r_onboard"] is None


@pytest.mark.parametrize(("offset", "step"), [(1e12, 1.0), (9e14, 0.125)])
def test_the_correlation_is_exact_for_large_offsets(print_table: Print, offset: float, step: float) -> None:
    """Every printed digit of r is right even if huge sizes differ only in the last bits of a float."""
    rows = [(offset + step * (i % 3), onboard, cloud) for i, (_, onboard, cloud) in enumerate(THOUSAND[:50])]
    exact = [tuple(Fraction(value) for value in row) for row in rows]
    found = lines_of(print_table(rows, windows=("20",)))[0]
    assert found[1:3] == [printed(r) for r in correlations(tuple(exact), 20)]


def test_the_correlation_is_the_same_in_blocks(print_table: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit on memory does not change any figure."""
    whole = print_table(THOUSAND[:100], windows=("5", "30"))
    monkeypatch.setattr("offboard.loadgen.table.table_two_figures.BLOCK_CELLS_MAX", 64)
    assert print_table(THOUSAND[:100], windows=("5", "30")) == whole


def test_equal_predictions_stay_onboard(print_table: Print) -> None:
    """If the predictions are equal, the task stays onboard and the cloud's window does not move."""
    rows = [(1.0, 2.0, 2.0)] * 3 + [(1.0, 2.0, 1.0)] * 5
    line = lines_of(print_table(rows, windows=("3",)))[0]
    assert (line[4], line[7], line[20]) == ("2.00000", "2.00000", "0.00")


def test_an_oracle_of_zero_seconds_has_no_ratio(print_table: Print) -> None:
    """If the oracle takes no time at all, time/oracle is undefined, but regret is not."""
    lines = lines_of(print_table([(1.0, 2.0, 0.0), (2.0, 2.0, 0.0), (3.0, 0.0, 2.0)], windows=()))
    assert [line[17:19] for line in lines] == [
        [UNDEFINED, cell] for cell in ("4.00000", "2.00000", "0.00000")
    ]


def test_extreme_values_give_finite_figures(print_table: Print) -> None:
    """The largest and the smallest allowed values give finite figures and no warning."""
    rows = [(1e15 * (i % 3) / 2, 1e15 / (i + 1), 5e-324 * i) for i in range(12)]
    (one,) = json.loads(print_table(rows, windows=("3", "full"), format="json"))["tables"]
    assert all(math.isfinite(x) for score in one["scores"] for x in score.values() if isinstance(x, float))
