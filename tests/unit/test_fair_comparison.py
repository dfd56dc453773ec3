"""A comparison divides by the better constant, puts the cost first, and says the result in words."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.comparison_line import MISSING
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.scenario import RobotPart, Scenario, Workload
from offboard.loadgen.table.table_formats import FORMATS, Table, render

DEADLINE_S = 0.2
WORKLOAD = Workload(task="m:f", sizes=("constant:1",), deadline_ms=1e3 * DEADLINE_S)
MEAN, LATE = RobotPart(), RobotPart(objective="deadline")


def played(seconds: Sequence[float], quality: float | None = None) -> list[Outcome]:
    """A run of one task for each of these times."""
    tasks = [
        Answered(i, "robot", i, i + one, None, None, "cloud", False, ("cloud",), quality=quality)
        for i, one in enumerate(seconds)
    ]
    return [Outcome({"robot": len(tasks)}, tasks, deadline_s=DEADLINE_S)]


def compared(runs: Mapping[str, list[Outcome]], robot: RobotPart = MEAN) -> Table:
    config = CompareConfig(policies=tuple(runs), seeds=1)
    return comparison_table(Scenario("small", 1, WORKLOAD, robot=robot), config, runs)


def ratios(table: Table, name: str) -> dict[str, Any]:
    return {line.policy: getattr(line, name) for line in table.lines if not line.bound}


STEADY, FAST_BUT_LATE, SLOW = [0.15] * 20, [0.05] * 16 + [0.3] * 4, [0.18] * 20


def test_the_divisor_is_the_better_constant_by_the_cost_of_the_scenario() -> None:
    """`cloud` has the lower mean and `onboard` fewer late tasks; the order of the policies plays no part."""
    runs = {"paper": played(SLOW), "cloud": played(FAST_BUT_LATE), "onboard": played(STEADY)}
    assert ratios(compared(runs), "over_constant") == {
        "paper": pytest.approx(1.8),
        "cloud": 1.0,
        "onboard": pytest.approx(1.5),
    }
    by_deadline = compared(runs, LATE)
    assert ratios(by_deadline, "over_constant")["onboard"] == 1.0
    assert ratios(by_deadline, "cost_over_constant") == {"paper": None, "cloud": None, "onboard": None}


@pytest.mark.parametrize("constants", [(), ("onboard",), ("cloud",)])
def test_without_both_constants_nothing_is_divided(constants: tuple[str, ...]) -> None:
    """The table says which policies to name."""
    table = compared({name: played(STEADY) for name in ("paper", *constants)})
    assert set(ratios(table, "over_constant").values()) == {None}
    assert table.ending == MISSING


@pytest.mark.parametrize(
    ("robot", "quality", "leading"),
    [
        (MEAN, None, ("tasks", "lost", "mean_ms")),
        (LATE, None, ("cost", "cost_over_constant", "tasks")),
        (MEAN, 0.8, ("cost", "cost_over_constant", "quality")),
    ],
)
def test_cost_and_quality_come_first_where_they_count(
    robot: RobotPart, quality: float | None, leading: tuple[str, ...]
) -> None:
    """They do where a scenario has an objective or variants; the quality is the mean of the answers."""
    table = compared({"onboard": played(STEADY, quality), "cloud": played(SLOW)}, robot)
    assert tuple(table.headings)[2:5] == leading == table.first[:3]
    assert ratios(table, "quality")["onboard"] == (None if quality is None else pytest.approx(quality))


def test_variants_are_divided_by_their_cost() -> None:
    """A faster answer of half the quality costs more than a slower whole one, so `cloud` is the divisor."""
    table = compared(
        {"default": played(STEADY, 1.0), "onboard": played([0.01] * 20, 0.5), "cloud": played(SLOW, 1.0)}
    )
    assert ratios(table, "cost_over_constant")["cloud"] == 1.0
    assert table.ending == (
        "default: 0.83 of the better constant (cloud) in cost, no task late, quality 1.00;"
        " quality of onboard alone 0.50 and of cloud alone 1.00."
    )


@pytest.mark.parametrize(
    ("runs", "robot", "said"),
    [
        (
            {
                "paper": played(SLOW),
                "default": played(STEADY),
                "onboard": played(SLOW),
                "cloud": played([0.3] * 20),
            },
            MEAN,
            "default: 0.83 of the better constant (onboard) in mean time, no task late;"
            " cloud alone was late in 100 %.",
        ),
        (
            {"onboard": played(STEADY), "cloud": played(FAST_BUT_LATE), "default": played(FAST_BUT_LATE)},
            LATE,
            "default: a cost of 0.2000, and 0.0000 of the better constant (onboard), late in 20 %;"
            " cloud alone was late in 20 %.",
        ),
        ({"onboard": played(STEADY), "cloud": played(SLOW)}, MEAN, "onboard is the better constant."),
    ],
)
def test_a_comparison_ends_with_one_sentence(
    runs: Mapping[str, list[Outcome]], robot: RobotPart, said: str
) -> None:
    """It names the better constant, and how late each constant was."""
    assert compared(runs, robot).ending == said


@pytest.mark.parametrize("format", [one for one in FORMATS if one != "csv"])
def test_the_sentence_is_printed(format: str) -> None:
    """Below the table in Markdown, in its caption in LaTeX, as a field in JSON."""
    text = render([compared({"onboard": played(STEADY), "cloud": played(SLOW)})], format)
    assert "onboard is the better constant." in text
    if format == "md":
        assert text.splitlines()[-1] == "- onboard is the better constant."
