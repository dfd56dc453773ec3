"""Simulated scenarios: runs that can be repeated, times that can be computed by hand, and no lost tasks."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S, HASH, START_S, RobotTasks, find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.cloud.cloud_socket import RECONNECT_MAX_MS
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.mazes import warm

warm()  # compiles before the clock of any test runs
HEAD = """name = "small"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["{sizes}"]
tasks = 60
{workload}
[robot]
{robot}
cpus = 0.2
window = 5
timeout = 0.5
[link]
delay_ms = 15
bandwidth_mbps = 8
"""


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Scenario]:
    """Reads a scenario that consists of HEAD and the given text."""

    def factory(
        text: str = "", workload: str = "", sizes: str = "uniform:1000:30000", robot: str = ""
    ) -> Scenario:
        path = tmp_path / "small.toml"
        path.write_text(HEAD.format(workload=workload, sizes=sizes, robot=robot) + text)
        return read_scenario(path)

    return factory


def tasks_of(scenario: Scenario) -> dict[str, RobotTasks]:
    """The tasks of its robots; all robots have the same workload."""
    workload = scenario.workload
    return {name: find_tasks(workload, scenario.seed, workload.tasks) for name in scenario.robots()}


def played(scenario: Scenario, policy: str = "paper", **more: float) -> Outcome:
    return simulate(scenario.changed(policy=policy), tasks_of(scenario), **more)


def onboard_s(rounds: float, hogs: int = 0) -> float:
    return (1 + hogs) / 0.2 * (DECIDING_CPU_S + HASH.cpu_s(rounds))


def cloud_s(rounds: float, bytes_moved: int) -> float:
    robot_s = (DECIDING_CPU_S + HASH.sending_s) / 0.2
    return robot_s + 2 * 0.015 + bytes_moved * 8e-6 / 8 + HASH.cpu_s(rounds)


@pytest.mark.parametrize("policy", ["paper", "paper-with-heartbeats", "hedge:probe:greedy"])
@pytest.mark.parametrize("arrivals", ["", 'arrivals = "bursts"\nrate = 12\nburst = 6'])
def test_a_seed_gives_the_same_run(read: Callable[..., Scenario], policy: str, arrivals: str) -> None:
    """Two runs of a seed are equal, also with several tasks at a time; another seed gives another run."""
    scenario = read("jitter_ms = 5\n", workload=arrivals)
    assert played(scenario, policy) == played(scenario, policy)
    assert played(scenario, policy) != played(scenario.changed(seed=2), policy)


def test_the_number_of_processes_changes_nothing(read: Callable[..., Scenario]) -> None:
    """Two processes give the same outcomes as one process."""
    seeds = [read().changed(seed=seed) for seed in (1, 2, 3)]
    strategies = {"paper": {"policy": "paper"}, "cloud": {"policy": "cloud"}}
    with SimulationPool(1) as one, SimulationPool(2) as two:
        assert one.play(seeds, strategies) == two.play(seeds, strategies)


def test_times_of_constant_policies_by_hand(read: Callable[..., Scenario]) -> None:
    """Without noise, onboard takes CPU time over quota, and the cloud takes the round trip plus the work."""
    scenario = read()
    asked = tasks_of(scenario)[ROBOT].tasks
    for policy, expected in (
        ("onboard", [onboard_s(one.work[ONBOARD]) for one in asked]),
        ("cloud", [cloud_s(one.work[CLOUD], one.bytes_out + one.bytes_in) for one in asked]),
    ):
        run = played(scenario, policy, noise=0.0)
        assert [one.response_s for one in run.answered] == pytest.approx(expected, abs=1e-9), policy


def test_references_are_the_times_of_each_site_alone(read: Callable[..., Scenario]) -> None:
    """With noise and jitter too, the references of a policy are the times of the constant policies."""
    scenario = read("jitter_ms = 5\nloss = 0.02\n")
    alone = {site: played(scenario, site) for site in ("onboard", "cloud")}
    for number, one in enumerate(played(scenario, "greedy").references):
        for site, run in alone.items():
            assert one.seconds[site] == pytest.approx(run.answered[number].response_s, abs=1e-9)


def test_the_reference_of_the_policy_is_the_waited_time(read: Callable[..., Scenario]) -> None:
    """A robot that measures both sites waits for the slower one, and `sent_s` says so."""
    run = played(read(workload="measure = 60"), noise=0.0)
    for answered, one in zip(run.answered, run.references, strict=True):
        assert one.sent_s == answered.response_s
        assert answered.response_s == pytest.approx(max(one.seconds.values()), abs=1e-9)


def test_tasks_in_an_outage_time_out(read: Callable[..., Scenario]) -> None:
    """In an outage a task waits for its timeout and runs onboard; after it the cloud answers again."""
    scenario = read(
        "[[event]]\nat_task = 20\nlink = {outage = true}\n[[event]]\nat_task = 24\nlink = {outage = false}\n"
    )
    asked = tasks_of(scenario)[ROBOT].tasks
    run = played(scenario, "cloud", noise=0.0)
    for number, one in enumerate(run.answered):
        expected = cloud_s(asked[number].work[CLOUD], asked[number].bytes_out + asked[number].bytes_in)
        if 20 <= number < 24:
            assert one.sites == ("cloud", "onboard")
            expected = 0.5 + onboard_s(asked[number].work[ONBOARD])
            assert run.references[number].given_up_s["cloud"] > 0.5
        # The server may still run the request that arrives at the end of the outage.
        behind = HASH.cpu_s(asked[20].work[CLOUD]) if number == 24 else 0.0
        assert expected - 1e-9 <= one.response_s <= expected + behind + 1e-9


def test_heartbeats_can_be_switched_on_and_off(read: Callable[..., Scenario]) -> None:
    """With heartbeats, the paper's rule does not warm up a silent site; `robot.heartbeats` decides."""
    scenario = read("[[event]]\nat_task = 2\nlink = {outage = true}\n")
    paper, beating = played(scenario, "paper"), played(scenario, "paper-with-heartbeats")
    assert paper != beating
    assert played(scenario.changed(heartbeats=True), "paper") == beating
    assert played(scenario.changed(heartbeats=False), "paper-with-heartbeats") == paper


def test_limits_of_the_robot_hold(read: Callable[..., Scenario]) -> None:
    """Without second runs none is probed or hedged. A cap of no bytes keeps known tasks off the server."""
    default = played(read(), "default")
    assert max(len(one.sites) for one in default.answered[30:]) == 2
    none = played(read(robot="duplicates = 0.0"), "default")
    assert max(len(one.sites) for one in none.answered[30:]) == 1
    capped = played(read(robot="bytes_a_minute = 0.0"), "default")
    assert {one.sites for one in capped.answered[30:]} == {("onboard",)}


def test_a_dead_server_is_not_used_until_it_is_back(read: Callable[..., Scenario]) -> None:
    """A crash fails the task in flight at once; tasks run onboard until the server is warm and connected."""
    scenario = read(
        "[[event]]\nat_s = 1.0\nkill = 'cloud'\n[[event]]\nat_s = 1.5\nstart = 'cloud'\n",
        sizes="constant:30000",
    ).changed(tasks=100)
    run = played(scenario, "cloud", noise=0.0)
    struck = next(one for one in run.answered if one.ended_s > 1.0)
    assert struck.sites == ("cloud", "onboard")
    assert struck.ended_s == pytest.approx(1.0 + HASH.cpu_s(30000) / 0.2, abs=1e-9)
    back_s = min(one.due_s for one in run.answered if one.due_s > 1.0 and one.chosen == "cloud")
    warm_s = 1.5 + START_S
    assert warm_s < back_s < warm_s + RECONNECT_MAX_MS / 1e3 + 0.3
    between = [one for one in run.answered if 1.0 < one.due_s < back_s]
    assert between
    assert {one.sites for one in between} == {("onboard",)}
    assert all("cloud" not in run.references[one.i].seconds for one in between)


def test_other_robots_slow_the_cloud_down(read: Callable[..., Scenario]) -> None:
    """With three other robots the cloud takes longer; while they are paused, it takes as long as alone."""
    few = {"workload": "robots = 4", "sizes": "constant:60000"}
    paused = "".join(f"[[event]]\nat_task = 0\npause = 'robot-{n}'\n" for n in (2, 3, 4))
    alone, busy, quiet = (
        played(scenario, "cloud", noise=0.0)
        for scenario in (read(sizes="constant:60000"), read(**few), read(paused, **few))
    )
    assert quiet.answered == alone.answered
    mean = FIGURES["mean_ms"].compute
    assert (mean(busy) or 0) > 1.1 * (mean(alone) or 0)


def test_measured_tasks_run_on_both_sites(read: Callable[..., Scenario]) -> None:
    """The first `measure` tasks run on both sites, whatever the policy."""
    run = played(read(workload="measure = 4"), "onboard")
    assert [len(one.sites) for one in run.answered[:6]] == [2, 2, 2, 2, 1, 1]


def test_the_cost_of_a_plan_depends_on_its_planner() -> None:
    """A faster planner takes less CPU time for a task, although each unit of its work takes longer."""
    workload = read_scenario(find_scenario("calm")).workload
    level, quick = (find_tasks(replace(workload, planner=name), 1, 5) for name in ("dijkstra", "jps"))
    assert [one.size for one in quick.tasks] == [one.size for one in level.tasks]
    assert quick.cost.s_per_unit > level.cost.s_per_unit
    for one, other in zip(quick.tasks, level.tasks, strict=True):
        assert quick.cost.cpu_s(one.work[CLOUD]) < level.cost.cpu_s(other.work[CLOUD])


def test_a_simulation_is_faster_than_real_time() -> None:
    """Simulating a run takes less CPU time than the run lasts, though its robot has a tenth of a CPU."""
    scenario = read_scenario(find_scenario("nonlinear"))
    tasks = tasks_of(scenario)
    began_s = time.thread_time()
    run = simulate(scenario.changed(policy="hedge:probe:greedy"), tasks)
    assert time.thread_time() - began_s < run.answered[-1].ended_s


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[event]]\nat_task = 3\nkill = 'robot'\n", "event kill of robot needs real processes"),
        ("[[event]]\nat_s = 3\npause = 'wan'\n", "event pause of wan needs real processes"),
        ("truncate_bytes = 900\n", "link condition truncate_bytes = 900 needs real connections"),
        ("[[event]]\nat_s = 3\nlink = {reset_after_ms = 50}\n", "link condition reset_after_ms = 50 needs"),
    ],
)
def test_what_cannot_be_simulated_is_refused(read: Callable[..., Scenario], text: str, said: str) -> None:
    """The error names the event or the link condition that needs real processes or connections."""
    with pytest.raises(ConfigError, match=f"^scenario small cannot be simulated: {said}"):
        check_simulated(read(text))


def test_inputs_are_not_simulated(read: Callable[..., Scenario]) -> None:
    """A scenario with inputs is refused before its modules are loaded."""
    workload = replace(read().workload, task="no_module:f", sizes=(), inputs="no_module:inputs")
    said = "^scenario small cannot be simulated: the costs of task no_module:f are not known"
    with pytest.raises(ConfigError, match=said):
        check_simulated(replace(read(), workload=workload))


def test_a_task_of_unknown_cost_is_refused(read: Callable[..., Scenario]) -> None:
    """The error lists the tasks whose costs are known."""
    workload = replace(read().workload, task="tests.probes:zeros")
    with pytest.raises(ConfigError, match=r"task zeros cannot be simulated: only the costs of plan_path"):
        find_tasks(workload, 1, 3)
