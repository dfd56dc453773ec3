"""Figures and checks of an outcome, and the table of a comparison, worked out by hand."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.compare.runs import rotated
from offboard.loadgen.scenario.outcome import Answered, Outcome, Reading, Reference
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.outcome_files import overhead_s
from offboard.loadgen.scenario.pass_fail_check import Check
from offboard.loadgen.scenario.scenario import Scenario, Workload


def answered(i: int, response_s: float, chosen: str = "cloud", **more: object) -> Answered:
    """Task `i`, due at second `i`."""
    fields = {"error": None, "answer": None, "both": False, "sites": (chosen,)} | more
    return Answered(i=i, robot="robot", due_s=i, ended_s=i + response_s, chosen=chosen, **fields)  # type: ignore[arg-type]


@pytest.fixture
def run() -> Outcome:
    """Ten tasks of 0.1 to 0.9 s: task 9 is lost, the first two ran on both sites, even ones onboard."""
    tasks = [
        answered(
            i,
            0.1 * (i + 1),
            "onboard" if i % 2 == 0 else "cloud",
            both=i < 2,
            sites=("onboard", "cloud") if i < 2 else ("cloud",),
            wrong="too long" if i == 3 else None,
            error="TaskFailed: no" if i == 4 else None,
            unverified="too large" if i == 5 else None,
            overhead_s=None if i < 2 else 0.001 * i,
            quality=None if i < 5 else 0.5 if i < 7 else 1.0,
        )
        for i in range(9)
    ]
    references = [
        Reference(3, "cloud", False, {"onboard": 0.2, "cloud": 0.1}, {}),
        Reference(5, "cloud", False, {"onboard": 0.1, "cloud": 0.3}, {}),
        Reference(7, "cloud", False, {"onboard": 0.1}, {"cloud": 0.5}),
        Reference(8, "onboard", True, {"onboard": 0.2, "cloud": 0.1}, {}),
    ]
    return Outcome({"robot": 10}, tasks, references, deadline_s=0.75)


@pytest.mark.parametrize(
    ("figure", "expected"),
    [
        ("lost", 1),
        ("wrong", 1),
        ("unverified", 1),
        ("failed", 1),
        ("quality", 0.75),
        ("mean_ms", 500),
        ("p95_ms", 900),
        ("p99_ms", 900),
        ("late_percent", 100 * 2 / 9),
        ("cloud_percent", 100 * 3 / 7),  # of the seven tasks that were sent to one site
        ("twice_percent", 100 * 2 / 9),
        ("accuracy_percent", 50),  # of tasks 3 and 5; task 7 has only one time, task 8 ran on both sites
        ("cost", (4.5 + 2 * 0.5) / 9),
        ("wait_over_oracle", (0.4 + 0.6 + 0.8 + 0.9) / (0.1 + 0.1 + 0.1 + 0.1)),
        ("time_over_oracle", (0.1 + 0.3 + (0.5 + 0.1) + 0.1) / (0.1 + 0.1 + 0.1 + 0.1)),
        ("overhead_ms", 5),  # the median of tasks 2 to 8, which take 0.3 to 0.9 s
        ("overhead_percent", 100 * 0.005 / 0.6),
        ("regret_ms", 1e3 * (0.0 + 0.2 + 0.5 + 0.0) / 4),
    ],
)
def test_every_figure_is_right(run: Outcome, figure: str, expected: float) -> None:
    """Each figure equals the one computed by hand from the ten tasks."""
    assert FIGURES[figure].compute(run) == pytest.approx(expected)


def test_a_range_of_a_run_counts_only_its_own_tasks(run: Outcome) -> None:
    """A range contains only its own asked, answered and reference tasks."""
    part = run.between(4, 8)
    assert FIGURES["lost"].compute(part) == 0
    assert [one.i for one in part.answered] == [4, 5, 6, 7]
    assert [one.i for one in part.references] == [5, 7]
    assert FIGURES["lost"].compute(run.between(8)) == 1


def test_the_tasks_of_other_robots_do_not_count(run: Outcome) -> None:
    """`of` leaves out what other robots asked for and what they were answered."""
    other = replace(answered(0, 2.7), robot="robot-2")
    both = replace(run, asked={**run.asked, "robot-2": 5}, answered=[*run.answered, other])
    assert both.of(("robot",)) == run
    assert both.of(("robot", "robot-2")) == both


@pytest.mark.parametrize(
    "figure",
    [
        "mean_ms",
        "overhead_ms",
        "overhead_percent",
        "cloud_percent",
        "time_over_oracle",
        "memory_growth_percent",
    ],
)
def test_a_figure_without_data_is_undefined(figure: str) -> None:
    """Without tasks, references or readings a figure is undefined, and a check of it fails."""
    nothing = Outcome({"robot": 0}, [])
    assert FIGURES[figure].compute(nothing) is None
    verdict = Check(figure=figure, at_most=1e9).judge(nothing)
    assert not verdict.holds
    assert str(verdict).endswith("undefined for these tasks")


def execution(site: str, seconds: float, **more: object) -> dict[str, object]:
    return {"site": site, "seconds": seconds, "ok": True, "queue_s": 0.01, "run_s": 0.08} | more


@pytest.mark.parametrize(
    ("executions", "expected_s"),
    [
        ([execution("cloud", 0.095)], 0.1 - 0.095),
        ([execution("onboard", 0.095)], 0.1 - 0.01 - 0.08),
        ([execution("cloud", 0.095, ok=False)], None),
        ([execution("cloud", 0.05, ok=False), execution("onboard", 0.045)], None),
        ([], None),
    ],
)
def test_the_overhead_is_what_a_task_waited_beyond_its_execution(
    executions: list[dict[str, object]], expected_s: float | None
) -> None:
    """Only tasks that ran on one site have one; onboard it includes the way to the worker and back."""
    found = overhead_s({"waited_s": 0.1, "executions": executions})
    assert found == (None if expected_s is None else pytest.approx(expected_s))


def test_growth_is_the_growth_of_the_part_that_grew_most() -> None:
    """Growth compares the medians of the first and the last third of the readings, so a peak is no growth."""
    flat = [Reading(t, "wan", 100, 10) for t in range(30)]
    grown = [Reading(t, "cloud", 100 + t, 10 + (t == 25)) for t in range(30)]
    run = Outcome({"robot": 0}, [], readings=flat + grown)
    early, late = 100 + 12.5, 100 + 26.5  # of readings 10 to 29, thirds of 6
    assert FIGURES["memory_growth_percent"].compute(run) == pytest.approx(100 * (late / early - 1))
    assert FIGURES["handles_growth_percent"].compute(run) == 0


@pytest.mark.parametrize(
    ("check", "said"),
    [
        (Check(figure="lost", at_most=1), "holds  lost at most 1 tasks: 1"),
        (Check(figure="lost", at_most=0), "FAILS  lost at most 0 tasks: 1, 1 above the limit"),
        (
            Check(figure="cloud_percent", at_least=80, from_task=2, to_task=6, note="known"),
            "FAILS  cloud_percent at least 80 %, tasks 2 to 5: 50, 30 below the limit (known)",
        ),
    ],
)
def test_a_verdict_says_by_how_much_it_fails(run: Outcome, check: Check, said: str) -> None:
    """A verdict names the check, the value, and the distance to the limit."""
    assert str(check.judge(run)) == said


def test_each_policy_comes_first_equally_often() -> None:
    """The order of the policies rotates by one from seed to seed."""
    assert [rotated("abc", n) for n in range(4)] == [list("abc"), list("bca"), list("cab"), list("abc")]


SMALL = Scenario("small", 1, Workload(task="m:f", sizes=("constant:1",)))
PLAYED = CompareConfig(policies=("onboard", "cloud", "paper"), seeds=1)


@pytest.fixture
def outcome() -> Callable[[float], Outcome]:
    """Forty cloud tasks that take `seconds` to 1.2 times as long; every fourth is a reference task."""

    def make(seconds: float) -> Outcome:
        tasks = [answered(i, seconds * (1 + 0.1 * (i % 3))) for i in range(40)]
        references = [
            Reference(i, "cloud", False, {"cloud": seconds, "onboard": 0.1}, {}) for i in range(0, 40, 4)
        ]
        return Outcome({"robot": 40}, tasks, references, deadline_s=0.3)

    return make


def test_a_comparison_pairs_equal_tasks(outcome: Callable[[float], Outcome]) -> None:
    """If every task takes twice as long, the ratio is exactly 2; regret equals the one by hand."""
    compared = comparison_table(
        SMALL, PLAYED, {"onboard": [outcome(0.1)], "cloud": [outcome(0.3)], "paper": [outcome(0.2)]}
    )
    (onboard, *_, paper, low, high) = compared.lines
    assert (onboard.policy, onboard.tasks, onboard.over_constant) == ("onboard", 40, 1.0)
    assert paper.over_constant == pytest.approx(2.0)
    assert (low.over_constant, high.over_constant) == (pytest.approx(2.0), pytest.approx(2.0))
    assert low.mean_ms < paper.mean_ms < high.mean_ms
    assert (paper.referenced, paper.time_over_oracle) == (10, pytest.approx(2.0))
    assert paper.regret_ms == pytest.approx(100)
    assert (paper.late_percent, paper.lost, paper.cloud_percent) == (0.0, 0, 100.0)


def test_a_lost_task_is_counted_but_not_compared(outcome: Callable[[float], Outcome]) -> None:
    """A policy that lost tasks is compared on its answered tasks only."""
    whole, part = outcome(0.1), outcome(0.2)
    part = Outcome(part.asked, part.answered[5:], part.references, deadline_s=part.deadline_s)
    compared = comparison_table(SMALL, PLAYED, {"onboard": [whole], "cloud": [outcome(0.3)], "paper": [part]})
    paper = next(line for line in compared.lines if line.policy == "paper" and not line.bound)
    assert (paper.lost, paper.tasks) == (5, 35)
    assert paper.over_constant == pytest.approx(2.0)
