"""Every shipped scenario in simulation: its checks hold with the default policy."""

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from tests.mazes import warm

warm()  # compiles before the clock of any test runs
POLICIES = ("default", "paper")
SEEDS = 2  # of each scenario; tasks of another seed are planned once more
TASKS_MAX = 400  # of a scenario that is played here
OPEN_TASKS_MAX = 4000  # of one whose tasks come at a rate, so that it has no references
LONG = {"demo", "paper", "congested", "drive", "drive-busy"}  # they make data sets or are shown: no checks


def scenario(name: str) -> Scenario:
    return read_scenario(find_scenario(name))


def refused(name: str) -> bool:
    """Whether the scenario needs real processes."""
    try:
        check_simulated(scenario(name))
    except ConfigError:
        return True
    return False


REFUSED = {name for name in shipped() if refused(name)}
SIMULATED = [name for name in shipped() if name not in REFUSED | LONG]


def test_few_scenarios_are_left_out() -> None:
    """Only applications with inputs, the soak with its faults, and those without checks are."""
    applications = {name for name in shipped() if scenario(name).workload.inputs is not None}
    assert REFUSED - applications <= {"soak"}
    for name in SIMULATED:
        workload = scenario(name).workload
        assert workload.tasks <= (TASKS_MAX if workload.arrivals == "closed" else OPEN_TASKS_MAX), name
    assert all(scenario(name).checks for name in SIMULATED)
    assert not any(scenario(name).checks for name in LONG)


@pytest.mark.timeout(120)  # the real planner plans every task once
@pytest.mark.parametrize("name", SIMULATED)
def test_the_checks_of_a_scenario_hold_in_simulation(name: str) -> None:
    """With the default policy, each check that needs no real process does; no policy loses a task.

    The verdicts of the published rule are printed only: some checks are about what it leaves out.
    """
    played = scenario(name)
    seeds = [played.changed(seed=played.seed + n) for n in range(SEEDS)]
    with SimulationPool(1) as pool:
        runs = pool.play(seeds, {policy: {"policy": policy} for policy in POLICIES})
    failed = dict[str, list[str]]()
    for policy, of_seeds in runs.items():
        verdicts = [
            one.judge(run) for run in of_seeds for one in played.checks if not FIGURES[one.figure].real
        ]
        print(f"{name} with {policy}:", *verdicts, sep="\n  ")
        failed[policy] = [str(one) for one in verdicts if not one.holds]
        for run in of_seeds:
            answered = sorted(one.i for one in run.answered if one.robot == "robot")  # bursts have no order
            assert answered == list(range(played.workload.tasks))
            over = FIGURES["time_over_oracle"].compute(run)
            assert played.workload.arrivals != "closed" or 0.95 < (over or 0.0) < 3, (policy, over)
    assert failed["default"] == []
