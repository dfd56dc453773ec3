"""The twelve rows that docs/evaluation.md works out by hand: the page, the command and plain loops agree."""

import re
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise

import pytest

from tests.table_loops import TWELVE, fit, lines_of, pearson, replay, rows_of, section

Print = Callable[..., str]


def test_the_page_shows_what_the_command_prints(print_table: Print) -> None:
    """docs/evaluation.md shows exactly what `loadgen table` prints for its twelve rows."""
    out = print_table(TWELVE, windows=("3", "full"), feedback="both")
    _, _, shown = section("What is printed").partition("feedback both --all`\n")
    assert shown.strip() == out.strip()


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_the_steps_on_the_page_equal_exact_arithmetic(feedback: str) -> None:
    """Every step on the page equals exact fractions from plain loops."""
    rows = [tuple(Fraction(cell) for cell in row) for row in rows_of(TWELVE)]
    steps = replay(rows, 3, 3, feedback)  # type: ignore[arg-type]
    lines = lines_of(section(f"Feedback {feedback}, row by row"))
    assert len(lines) == len(steps) == 9
    for at, (line, step) in enumerate(zip(lines, steps, strict=True), 3):
        size, onboard_s, cloud_s = rows[at]
        spent, best = (cloud_s if step.cloud else onboard_s), min(onboard_s, cloud_s)
        assert [int(line[0]), *map(Fraction, line[1:2] + line[4:6])] == [
            at + 1,
            size,
            step.p_onboard,
            step.p_cloud,
        ]
        assert line[6] == ("cloud" if step.cloud else "onboard")
        assert list(map(Fraction, line[7:9])) == [onboard_s, cloud_s]
        assert line[9:] == ["yes" if spent == best else "no", str(spent - best)]


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_the_windows_on_the_page_are_right(feedback: str) -> None:
    """The windows on the page give its predictions, and a window that moves drops its oldest observation."""
    rows = rows_of(TWELVE)
    lines = lines_of(section(f"Feedback {feedback}, row by row"))
    shown = [
        [[(float(d), float(t)) for d, t in re.findall(r"\((\d),(\d)\)", cell)] for cell in line[2:4]]
        for line in lines
    ]
    for line, windows in zip(lines, shown, strict=True):
        predicted = [fit(window, float(line[1])) for window in windows]
        assert predicted == pytest.approx([float(line[4]), float(line[5])])
    for at, (line, (before, after)) in enumerate(zip(lines, pairwise(shown), strict=False), 3):
        for side, site in enumerate(("onboard", "cloud")):
            moved = feedback == "full" or line[6] == site
            seen = (rows[at][0], rows[at][1 + side])
            assert after[side] == ([*before[side][1:], seen] if moved else before[side])


def test_the_correlations_on_the_page_are_right() -> None:
    """The correlation of each window on the page equals the one from plain loops, or is undefined in both."""
    rows = rows_of(TWELVE)
    for at, line in enumerate(lines_of(section("Correlations"))):
        assert line[0] == f"{at + 1}-{at + 3}"
        for side, cell in ((2, line[3]), (1, line[6])):
            r = pearson([row[0] for row in rows[at : at + 3]], [row[side] for row in rows[at : at + 3]])
            shown = cell.split("= ")[-1]
            assert shown == "undefined" if r is None else float(shown) == pytest.approx(r, abs=5e-6)
