"""Numbers and durations for people: units, digits and intervals."""

import math

import pytest

from offboard.common.wording import duration, rounded, with_bounds, with_interval


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [
        (0.0447, "44.7 ms"),
        (0.1, "100 ms"),
        (0.99949, "999 ms"),
        (0.9996, "1 s"),
        (1.06, "1.06 s"),
        (59.94, "59.9 s"),
        (999.7, "1000 s"),
        (12345.6, "12300 s"),
        (0.000031234, "0.0312 ms"),
        (4e-8, "0 ms"),
        (0.0, "0 ms"),
        (-0.0304, "-30.4 ms"),
        (-1.5, "-1.5 s"),
        (math.inf, "inf s"),
    ],
)
def test_a_duration_has_three_digits_and_a_unit(seconds: float, shown: str) -> None:
    """From 1 s on it is in seconds, below in milliseconds."""
    assert duration(seconds) == shown


@pytest.mark.parametrize("exponent", range(-9, 7))
def test_no_duration_has_an_exponent(exponent: int) -> None:
    """Neither a short nor a long one, nor one just below a power of ten; three digits are right."""
    for factor in (1.0, 1.006, 9.994, 9.996):
        seconds = factor * 10.0**exponent
        number, unit = duration(seconds).split()
        assert "e" not in number
        found = float(number) / {"ms": 1e3, "s": 1.0}[unit]
        assert found == pytest.approx(seconds, rel=0.006, abs=1.1e-7)


def test_a_number_keeps_its_digits() -> None:
    """As many as asked for; the zeros behind them are not written, and a tiny number is not 0."""
    assert [rounded(1234.56), rounded(12345.6, 4), rounded(0.5), rounded(2.0, 2), rounded(-99.96)] == [
        "1230",
        "12350",
        "0.5",
        "2",
        "-100",
    ]
    assert [rounded(0.0), rounded(5e-6), rounded(math.nan)] == ["0", "5e-06", "nan"]


def test_an_interval_has_the_unit_of_its_mean() -> None:
    """So two sites are compared in one unit, even if one of them may be very late."""
    assert with_interval(0.0447, 0.0232, 0.0562) == "44.7 ms [23.2, 56.2]"
    assert with_interval(0.0447, 0.0232, 1.0634) == "44.7 ms [23.2, 1060]"
    assert with_interval(1.06, 0.3, 92.8) == "1.06 s [0.3, 92.8]"


def test_an_interval_from_0_on_names_its_upper_end_only() -> None:
    """No task takes 0 ms; a saving may be 0, so it keeps both ends."""
    assert with_interval(0.0928, 0.0, 0.0928) == "92.8 ms [up to 92.8]"
    assert with_interval(0.0928, 1e-9, 0.12) == "92.8 ms [up to 120]"
    assert with_bounds(0.01, 0.0, 0.02) == "10 ms [0, 20]"
    assert with_bounds(-0.03, -0.03, 0.0) == "-30 ms [-30, 0]"
