"""What tasks cost by the objective of a scenario, from the trace to the table of a comparison."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.robot_files import late_executions
from offboard.loadgen.scenario.outcome import Answered, Costing, Outcome, Spent
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.outcome_files import spent_of
from offboard.loadgen.scenario.scenario import RobotPart, Scenario, Workload
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.robot_client.policies.objectives import Deadline, Mean, Tail, TimeAndSpending

WORKLOAD = Workload(task="m:f", sizes=("constant:1",), deadline_ms=200)
ENERGY = {"compute_w": 5.0, "idle_w": 1.0, "radio_j_byte": 1e-6}


def execution(site: str, seconds: float, **more: Any) -> dict[str, Any]:
    unknown = {"cpu_s": None, "queue_s": None}
    return {"site": site, "seconds": seconds, "started": True, "bytes_out": 0, "bytes_in": 0} | unknown | more


def test_all_runs_of_a_task_are_spent() -> None:
    """Late runs count with their ends; a cancelled run onboard counts with the CPU that it may have had."""
    record = {
        "id": "a",
        "features": {"onboard.capacity": 0.2},
        "waited_s": 0.5,
        "executions": [
            execution("onboard", 0.5),
            execution("cloud", 0.1, bytes_out=100),
            execution("edge", 0.2, bytes_out=10, bytes_in=5),
        ],
    }
    later = {"late": [{"id": "a"} | execution("cloud", 0.3, bytes_out=100, bytes_in=50)]}
    spent = spent_of(record, late_executions([record, later]))
    assert spent == Spent(pytest.approx(0.1), pytest.approx(0.3), 165)
    answered_sooner = spent_of(record | {"waited_s": 0.25}, {})
    assert answered_sooner.remote_s == 0.25, "two servers at once are one wait"


@pytest.mark.parametrize(
    ("run", "cpu_s"),
    [
        (execution("onboard", 0.5, cpu_s=0.07), 0.07),
        (execution("onboard", 0.5, queue_s=0.3), 0.2 * 0.2),
        (execution("onboard", 0.5, started=False), 0.0),
    ],
)
def test_a_run_onboard_takes_no_cpu_while_it_waits(run: dict[str, Any], cpu_s: float) -> None:
    """A run that was cancelled before it began takes none at all."""
    record = {"id": "a", "features": {"onboard.capacity": 0.2}, "waited_s": 0.5, "executions": [run]}
    assert spent_of(record, {}) == Spent(pytest.approx(cpu_s))


@pytest.mark.parametrize(
    ("costing", "expected"),
    [
        (Costing(), 0.3),
        (Costing(objective="p95"), 0.3),
        (Costing(objective="deadline", deadline_s=0.25), 1.0),
        (Costing(objective="deadline", deadline_s=0.35), 0.0),
        (Costing(objective="energy", s_per_joule=2.0, **ENERGY), 0.3 + 2.0 * (5.0 * 0.1 + 0.2 + 0.05)),
        (Costing(objective="metered", s_per_megabyte=4.0, **ENERGY), 0.3 + 4.0 * 0.05),
    ],
)
def test_a_task_costs_what_its_objective_weighs(costing: Costing, expected: float) -> None:
    """A task of 0.3 s took 0.1 CPU seconds, 0.2 s at a server and 50,000 bytes."""
    assert costing.of_task(0.3, None, Spent(0.1, 0.2, 50_000)) == pytest.approx(expected)


def test_lost_quality_costs_too() -> None:
    """The whole quality is worth a second, or what the robot says. For `deadline` it is the lost share."""
    assert Costing().of_task(0.3, 0.9, Spent()) == pytest.approx(0.4)
    assert Costing(s_per_quality=3.0).of_task(0.3, 0.9, Spent()) == pytest.approx(0.6)
    assert Costing(objective="deadline", deadline_s=1.0).of_task(0.3, 0.9, Spent()) == pytest.approx(0.1)


def test_a_task_that_failed_has_missed_its_deadline() -> None:
    """However soon its error came; an objective without a deadline counts its time."""
    (failed, *_) = outcome(0.1, Spent(), error="TaskFailed").answered
    assert failed.cost(Costing(objective="deadline", deadline_s=1.0)) == 1.0
    assert failed.cost(Costing()) == pytest.approx(0.1)


def outcome(seconds: float, spent: Spent, error: str | None = None) -> Outcome:
    """Twenty tasks of `seconds`, the last two of ten times as long."""
    return Outcome(
        {"robot": 20},
        [
            Answered(
                i=i,
                robot="robot",
                due_s=i,
                ended_s=i + seconds * (10 if i > 17 else 1),
                error=error,
                answer=None,
                chosen="cloud",
                both=False,
                sites=("cloud",),
                spent=spent,
            )
            for i in range(20)
        ],
    )


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        ({"objective": "mean"}, 0.1 * 38 / 20),
        ({"objective": "p95"}, 1.0),
        ({"objective": "deadline"}, 0.1),
        ({"objective": "metered", "s_per_megabyte": 1.0}, 0.1 * 38 / 20 + 0.5),
    ],
)
def test_a_comparison_judges_all_policies_by_the_objective_of_the_scenario(
    robot: Mapping[str, Any], expected: float
) -> None:
    """Also a variant that decides by another objective; the figure `cost` of a run says the same."""
    scenario = Scenario("small", 1, WORKLOAD, robot=RobotPart(**robot))
    config = CompareConfig(policies=("onboard", "cloud", "default", "default+mean"), seeds=1)
    cheap, dear = (outcome(seconds, Spent(bytes=moved)) for seconds, moved in ((0.1, 5e5), (0.15, 1e6)))
    played = {"onboard": [cheap], "cloud": [dear], "default": [cheap], "default+mean": [dear]}
    lines = {line.policy: line for line in comparison_table(scenario, config, played).lines if not line.bound}
    assert lines["default"].cost == pytest.approx(expected)
    judged = replace(cheap, costing=scenario.costing)
    assert FIGURES["cost"].compute(judged) == pytest.approx(expected)
    assert lines["default+mean"].cost_over_constant == pytest.approx(lines["cloud"].cost / expected)


@pytest.mark.parametrize("objective", ["mean", "p95"])
def test_a_cost_is_compared_on_the_tasks_that_both_policies_answered(objective: str) -> None:
    """The better constant lost the two long tasks; on the others, the other policy is as good."""
    scenario = Scenario("small", 1, WORKLOAD, robot=RobotPart(objective=objective))
    config = CompareConfig(policies=("onboard", "cloud", "default"), seeds=1)
    whole = outcome(0.1, Spent())
    lost = replace(whole, answered=whole.answered[:18])
    played = {"onboard": [lost], "cloud": [outcome(0.2, Spent())], "default": [whole]}
    lines = [one for one in comparison_table(scenario, config, played).lines if one.policy == "default"]
    assert [line.cost_over_constant for line in lines] == [pytest.approx(1.0)] * len(lines)


@pytest.mark.parametrize(
    ("robot", "objective", "flags"),
    [
        ({}, Mean(), {}),
        ({"objective": "p95"}, Tail(), {"objective": "p95"}),
        ({"objective": "deadline"}, Deadline(0.2), {"objective": "deadline", "deadline": 0.2}),
        ({"objective": "deadline", "policy": "default+mean"}, Mean(), {}),
        ({"objective": "deadline", "policy": "paper"}, Mean(), {}),
        (
            {"objective": "energy", "s_per_joule": 2.0, "compute_w": 5.0},
            TimeAndSpending(2.0),
            {"objective": "energy", "s_per_joule": 2.0, "compute_w": 5.0},
        ),
        (
            {"objective": "metered", "s_per_megabyte": 3.0, "s_per_joule": 2.0},
            TimeAndSpending(2.0, 3.0),
            {"objective": "metered", "s_per_megabyte": 3.0, "s_per_joule": 2.0},
        ),
    ],
)
def test_a_robot_decides_by_the_objective(
    tmp_path: Path, robot: Mapping[str, Any], objective: object, flags: Mapping[str, Any]
) -> None:
    """The simulation gets the objective, a robot process its flags; a policy without costs gets neither."""
    scenario = Scenario("small", 1, WORKLOAD, robot=RobotPart(**robot))
    found = scenario.settings(1).objective
    assert type(found) is type(objective)
    assert vars(found) == vars(objective)
    given = setups(scenario, tmp_path)["robot"].flags
    names = ("objective", "deadline", "s_per_joule", "s_per_megabyte", "compute_w")
    assert {name: given[name] for name in names if name in given}.items() >= flags.items()
    assert ("objective" in given) == bool(flags)


def test_a_variant_needs_what_its_objective_needs() -> None:
    """A scenario without a deadline cannot be played with `default+deadline`."""
    calm = read_scenario(find_scenario("calm"))
    with pytest.raises(ConfigError, match=r"'deadline' needs workload\.deadline_ms"):
        calm.changed(policy="default+deadline")
    assert calm.changed(policy="default+p95").robot.decides_by == "p95"
