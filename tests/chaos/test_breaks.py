"""Every check can fail: it does so with the policy or the broken part that it names in `fails_with`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.loadgen.play import play_scenario
from offboard.loadgen.play.play_scenario import Played, play
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.robot_client import policies
from offboard.robot_client.policies.objectives import OBJECTIVES
from tests.breaks import BREAKS, bed_with
from tests.chaos.plays import ALL, BROKEN, LEAK_TASKS, SCENARIOS, WRONG, skip_if_unplayable

# Their answers are compared within a tolerance.
APPLICATIONS = ("apriltags", "registration", "signs", "pose-graph", "arm")
SLOWER = 0.5  # CPU share of a robot that plans onboard: on a fast machine that policy might not fail

BY_MEAN = f"{policies.ALIAS}+{OBJECTIVES[0]}"  # the default with another objective than the scenario's

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Scenario, str], Played]:
    """Plays a scenario with a policy that must fail, or with a broken part."""

    def run(scenario: Scenario, name: str) -> Played:
        if name == "onboard":
            cpus = SLOWER * scenario.robot.cpus
            scenario = replace(scenario, robot=replace(scenario.robot, cpus=cpus))
        if name not in BREAKS:
            return play(scenario.changed(policy=name), tmp_path, quiet=True)
        change, cloud = BREAKS[name]
        monkeypatch.setitem(play_scenario.TESTBEDS, "local", bed_with(cloud))
        return play(change(scenario), tmp_path, quiet=True)

    return run


def failing(scenario: Scenario) -> dict[str, list[str]]:
    """The checks of a scenario, by what they fail with, if anything."""
    found: dict[str, list[str]] = {}
    for check in scenario.checks:
        if check.fails_with:
            found.setdefault(check.fails_with, []).append(str(check))
    return found


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_check_names_what_it_fails_with(name: str) -> None:
    """Every check fails with a policy or a broken part, or notes why not; lost and wrong ones are checked."""
    scenario = read_scenario(find_scenario(name))
    assert failing(scenario).keys() <= {*policies.names(), BY_MEAN, *BREAKS}
    assert [str(check) for check in scenario.checks if not check.fails_with and not check.note] == []
    assert scenario.about
    for figure, fails_with in (("lost", "dead-robot"), ("wrong", "lying-cloud")):
        assert [c.fails_with for c in scenario.checks if c.figure == figure] == [fails_with]


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        *(
            (name, wrong)
            for name in WRONG
            for wrong in failing(read_scenario(find_scenario(name)))
            if wrong not in BREAKS
        ),
        *(("calm", part) for part in BROKEN),  # all scenarios have these checks
        *((f"{name}-calm", "lying-cloud") for name in APPLICATIONS if ALL),
    ],
)
def test_a_check_fails_with_what_it_names(broken: Callable[..., Played], name: str, wrong: str) -> None:
    """Played with that policy or broken part, the check fails and says by how much."""
    scenario = read_scenario(find_scenario(name))
    skip_if_unplayable(scenario)
    played = broken(scenario, wrong)
    print(*played.verdicts, sep="\n")
    held = {str(verdict.check): verdict.holds for verdict in played.verdicts}
    assert [held[check] for check in failing(scenario)[wrong]] == [False] * len(failing(scenario)[wrong])
    assert all("the limit" in str(one) for one in played.verdicts if not one.holds)


@pytest.mark.skipif(not ALL, reason="CHAOS=1 is not set: make chaos plays it")
def test_a_leak_fails_the_soak(broken: Callable[..., Played]) -> None:
    """A server that leaks a little with every task fails the checks of memory and of open files."""
    scenario = read_scenario(find_scenario("soak")).changed(tasks=LEAK_TASKS)
    played = broken(scenario, "leaky-cloud")
    failed = {one.check.figure for one in played.verdicts if not one.holds}
    print(*played.verdicts, sep="\n")
    assert failed >= {"memory_growth_percent", "handles_growth_percent"}
