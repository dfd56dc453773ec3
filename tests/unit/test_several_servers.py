"""Scenarios with several servers: their format, their events, and the figures of each server."""

from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.errors import DataError
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.play.player import started_at_first
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES, site_percent
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import read_scenario
from offboard.loadgen.scenario.site_shares import share_lines, site_shares
from offboard.loadgen.simulation.model.task_costs import find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.container_part import addresses
from offboard.loadgen.testbed.local_testbed import LocalTestbed

HEAD = """name = "two"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["uniform:100000:200000"]
tasks = 100
[robot]
cpus = 0.1
[link]
delay_ms = 20
[[cloud]]
name = "cloud"
[[cloud]]
name = "edge"
{edge}
link = {{ delay_ms = 2 }}
"""


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Scenario]:
    """Reads a scenario that consists of HEAD and the given text."""

    def factory(text: str = "", edge: str = "") -> Scenario:
        path = tmp_path / "two.toml"
        path.write_text(HEAD.format(edge=edge) + text)
        return read_scenario(path)

    return factory


def simulated(scenario: Scenario) -> Outcome:
    return simulate(scenario, {"robot": find_tasks(scenario.workload, 1, scenario.workload.tasks)})


def shares(run: Outcome, first: int, last: int) -> tuple[float, float]:
    """The share of cloud and edge in these tasks, in percent."""
    part = run.between(first, last)
    return site_percent(part, "cloud") or 0.0, site_percent(part, "edge") or 0.0


def test_each_server_has_its_own_relay_and_link(read: Callable[..., Scenario]) -> None:
    """The link of a server is that of the scenario with its own changes; every robot knows all servers."""
    scenario = read(edge="cpus = 0.5")
    assert scenario.parts() == ("cloud", "edge", "wan", "wan-edge", "robot")
    assert scenario.links() == {"cloud": {"delay_ms": 20}, "edge": {"delay_ms": 2}}
    made = setups(scenario, Path("out"))
    assert (made["wan"].flags["delay_ms"], made["wan-edge"].flags["delay_ms"]) == (20, 2)
    assert made["wan"].flags["truth"] == Path("out/link.jsonl")
    assert made["wan-edge"].flags["truth"] == Path("out/link-edge.jsonl")
    assert (made["cloud"].cpus, made["edge"].cpus) == (1.0, 0.5)


def test_both_testbeds_give_robots_and_relays_the_addresses_of_all_servers(
    read: Callable[..., Scenario], tmp_path: Path
) -> None:
    """A server of a group has the site GROUP/NAME; the relay of a server leads to it."""
    made = setups(read(edge='group = "near"'), tmp_path)
    assert addresses("robot", made) == {"cloud": "tcp://wan:5555", "site": "near/edge=tcp://wan-edge:5555"}
    assert addresses("wan-edge", made) == {"to": "edge:5555"}
    assert addresses("edge", made) == {}
    parts = LocalTestbed(tmp_path, made).parts
    listen = next(flag for flag in parts["edge"].command if flag.startswith("--listen="))
    to = next(flag for flag in parts["wan-edge"].command if flag.startswith("--to="))
    assert listen.removeprefix("--listen=tcp://") == to.removeprefix("--to=")
    relay = next(flag for flag in parts["wan-edge"].command if flag.startswith("--listen="))
    assert f"--site=near/edge=tcp://{relay.removeprefix('--listen=')}" in parts["robot"].command


@pytest.mark.parametrize(
    ("text", "edge", "said"),
    [
        ('[[cloud]]\nname = "edge"', "", "cloud, edge, edge: each name once, and cloud among them"),
        ('[[cloud]]\nname = "robot"', "", "cloud.name: 'robot' is not a name of letters, digits and _"),
        ("", 'grupo = "a"', "two.toml:14: unknown key 'grupo'; did you mean 'group'?"),
        (
            "[[event]]\nat_task = 1\non = 'fog'\nreset = true",
            "",
            ":18: on: 'fog' is not one of cloud",
        ),
        ("[[event]]\nat_task = 1\non = 'edge'\nkill = 'edge'", "", "only an event with link or reset"),
        ("[[check]]\nfigure = 'cloud_percent'\nsite = 'fog'\nat_most = 1", "", "'fog' is not one of onboard"),
        (
            "[[check]]\nfigure = 'lost'\nsite = 'edge'\nat_most = 1",
            "",
            "only for the figure cloud_percent",
        ),
        ("[chaos]\nevery_s = 9", "", "chaos: random faults"),
    ],
)
def test_a_mistake_is_refused(read: Callable[..., Scenario], text: str, edge: str, said: str) -> None:
    """The error names the value and what is allowed."""
    with pytest.raises(DataError) as refused:
        read(text, edge)
    assert said in str(refused.value)


def test_the_near_server_is_used_until_its_link_gets_slow(read: Callable[..., Scenario]) -> None:
    """An event on one link leaves the other as it is."""
    run = simulated(read("[[event]]\nat_task = 30\non = 'edge'\nlink = { delay_ms = 200 }"))
    assert shares(run, 10, 30)[1] >= 90
    assert shares(run, 40, 60)[0] >= 90


def test_a_server_that_dies_loses_no_task_and_another_one_goes_on(read: Callable[..., Scenario]) -> None:
    """Only tasks that it had when it died run twice; nothing is lost."""
    run = simulated(read("[[event]]\nat_task = 30\nkill = 'edge'"))
    assert FIGURES["lost"].compute(run) == 0
    assert shares(run, 30, 60) == pytest.approx((100, 0), abs=5)


def test_a_server_that_an_event_starts_is_absent_before(read: Callable[..., Scenario]) -> None:
    """Its relay runs from the beginning, and robots use it soon after its start."""
    scenario = read("[[event]]\nat_task = 20\nstart = 'edge'")
    assert started_at_first(scenario) == ("cloud", "wan", "wan-edge")
    run = simulated(scenario)
    assert shares(run, 0, 20)[1] == 0
    assert shares(run, 75, 100)[1] >= 60


def test_the_shares_of_the_sites_are_told_in_equal_parts_of_the_run() -> None:
    """A task that ran on all sites counts for none; a part without other tasks has no share."""
    sites = ["edge"] * 10 + ["cloud", "edge"] * 5
    answered = [
        Answered(i, "robot", i, i + 0.1, None, None, site, i < 2, (site,)) for i, site in enumerate(sites)
    ]
    found = site_shares(Outcome({"robot": 20}, answered), ("onboard", "cloud", "edge"))
    assert found["edge"] == [None, *[100.0] * 4, *[50.0] * 5]
    assert found["onboard"] == [None, *[0.0] * 9]
    assert share_lines(found)[-1].split() == ["edge", "–", *["100"] * 4, *["50"] * 5]  # noqa: RUF001
