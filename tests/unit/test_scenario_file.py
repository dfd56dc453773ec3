"""Scenario files: what is read from them, and that every mistake in one is an error of one line."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.event_timeline import Timeline, absent_at_first
from offboard.loadgen.scenario.random_faults import FAULTS, Chaos
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

LINK = LinkFlags(delay_ms=7.0, down_delay_ms=9.0, loss=0.01).link
HEAD = """name = "small"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["constant:1000"]
tasks = 50
robots = 2
"""


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str], Scenario]:
    """Reads a scenario file that consists of the head above and the given text."""

    def factory(text: str) -> Scenario:
        path = tmp_path / "small.toml"
        path.write_text(HEAD + text)
        return read_scenario(path)

    return factory


def test_an_event_is_due_once_by_time_or_by_task(read: Callable[[str], Scenario]) -> None:
    """An event is returned once, when it is due; events due together keep their order in the file."""
    events = read(
        '[[event]]\nat_s = 2\nkill = "cloud"\n[[event]]\nat_task = 3\nstart = "cloud"\n'
        "[[event]]\nat_s = 1.5\nlink = {delay_ms = 3}\n"
    ).events
    timeline = Timeline(events)
    assert timeline.due(1.0, 2) == []
    assert [event.action for event in timeline.due(2.5, 2)] == ["kill", "link"]
    assert [event.action for event in timeline.due(2.6, 3)] == ["start"]
    assert timeline.due(99.0, 99) == []
    assert not timeline.left()


@pytest.mark.parametrize(("text", "heartbeats"), [("", None), ("true", True), ("false", False)])
def test_a_scenario_may_switch_heartbeats(
    read: Callable[[str], Scenario], text: str, heartbeats: bool | None
) -> None:
    """Without the key, the policy of the robots decides."""
    assert read(f"[robot]\nheartbeats = {text}\n" if text else "").robot.heartbeats == heartbeats


def test_a_part_that_an_event_starts_is_absent_before(read: Callable[[str], Scenario]) -> None:
    """A part is absent at first if its first event is a start, but not if it is killed before that."""
    events = read(
        '[[event]]\nat_task = 3\nstart = "robot-2"\n[[event]]\nat_task = 4\nkill = "cloud"\n'
        '[[event]]\nat_task = 5\nstart = "cloud"\n'
    ).events
    assert absent_at_first(events) == {"robot-2"}


def test_random_faults_are_drawn_from_the_seed() -> None:
    """The same seed gives the same faults, another seed other ones, and all lie within the run."""
    chaos = Chaos(every_s=10, last_s=2)
    assert chaos.events(3, 600, LINK) == chaos.events(3, 600, LINK)
    assert chaos.events(3, 600, LINK) != chaos.events(4, 600, LINK)
    events = chaos.events(3, 600, LINK)
    assert all(0 <= event.at_s <= 600 for event in events if event.at_s is not None)
    many = Chaos(every_s=1, last_s=0.5).events(1, 400, LINK)
    assert {event.action for event in many} == {"link", "reset", "hogs", "kill", "start", "pause", "resume"}
    assert set(FAULTS) >= {"outage", "hang", "truncate", "reset"}


def test_random_faults_restore_the_link() -> None:
    """After each fault, both directions of the link have the conditions of the scenario again."""
    link = LINK
    for event in Chaos(every_s=1, last_s=0.5).events(1, 400, LINK):
        if event.action == "link":
            link = link.changed(event.value)
            changed = link != LINK
            assert changed == (event.at_s is not None and "up" not in event.value)
    assert link == LINK


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[event]]\nat_s = 1\nklil = "cloud"\n', r":9: unknown event or key 'klil'; did you"),
        ('[[event]]\nat_s = 1\nkill = "clod"\n', r":9: kill: 'clod' is not one of cloud, wan,"),
        ('[[event]]\nat_s = -1\nkill = "cloud"\n', r":8: at_s: -1 is not a number from 0 to 86400"),
        ('[[event]]\nkill = "cloud"\n', r":7: give either at_s or at_task, not none"),
        ("[[event]]\nat_task = 1\n", r":7: an event without an action; give one of link,"),
        ("[[event]]\nat_task = 1.5\nreset = true\n", r":8: at_task: 1\.5 is not a whole number"),
        ("[[event]]\nat_task = 1\nreset = 1\n", r":9: reset: 1 is not true"),
        ("[[event]]\nat_task = 1\nlink = {delai_ms = 3}\n", r":9: link: .*delai_ms"),
        ("[[event]]\nat_task = 1\ncpus = {robot = 900}\n", r":9: cpus: 900 is not a number from 0\.05 to 64"),
        ("[[event]]\nat_task = 1\nhogs = {wan = 1}\n", r":9: hogs: the relay has no CPU quota"),
        ("event = 3\n", r"workload|unknown key 'event'"),
        ('[[check]]\nfigure = "lots"\nat_most = 1\n', r":8: .*unknown figure 'lots'; did you mean 'lost'\?"),
        ('[[check]]\nfigure = "lost"\nat_mots = 1\n', r":9: unknown key 'at_mots'; did you mean 'at_most'\?"),
        ('[[check]]\nfigure = "lost"\n', r":8: .*give either at_most or at_least"),
        ('[[check]]\nfigure = "regret_ms"\nat_most = 2\n', r":8: .*cannot be .* without workload\.reference"),
        ('[[check]]\nfigure = "late_percent"\nat_most = 2\n', r":8: .* without workload\.deadline"),
        ('[[check]]\nfigure = "lost"\nat_most = 0\nfrom_task = 50\n', r":8: .*task 50 is not among the 50"),
        ("[chaos]\nevery_s = 3\n", r"chaos: .*; workload\.arrivals must not be closed"),
        ('[robot]\nobjective = "fast"\n', r"robot\.objective: 'fast' is not one of mean, p95, deadline,"),
        ('[robot]\nobjective = "deadline"\n', r"robot\.objective: 'deadline' needs workload\.deadline_ms"),
        ('[robot]\nobjective = "energy"\n', r"robot\.objective: energy needs robot\.s_per_joule"),
        ("[robot]\ns_per_megabyte = 3\n", r"robot\.s_per_megabyte: 3 needs robot\.objective metered"),
        ('[robot]\npolicy = "paper+p95"\n', r"robot\.policy: 'paper\+p95': an objective changes nothing"),
        ('[robot]\npolicy = "default+best"\n', r"robot\.policy: .*: 'best' is not one of mean, p95,"),
        ("reference = -1\n", r"workload\.reference: -1 is below 0"),
        ('planner = "theta"\n', r"workload\.planner: 'theta' is not one of dijkstra, astar, jps"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_is_an_error_of_one_line(
    read: Callable[[str], Scenario], text: str, said: str
) -> None:
    """The error names the file, the line or field, the value, and what is allowed."""
    with pytest.raises(DataError, match=said) as caught:
        read(text)
    assert "small.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_check_needs_its_tasks(read: Callable[[str], Scenario]) -> None:
    """A run cannot be made shorter than the first task of a check."""
    scenario = read('[[check]]\nfigure = "lost"\nat_most = 0\nfrom_task = 40\n')
    with pytest.raises(ConfigError, match="task 40 is not among the 20 of the workload"):
        scenario.changed(tasks=20)


def test_a_scenario_is_found_by_name_or_path() -> None:
    """A shipped scenario is found by its name; an unknown name is an error that names the nearest one."""
    assert find_scenario("calm").is_file()
    with pytest.raises(DataError, match=r"^unknown scenario 'clam'; did you mean 'calm'\?$"):
        find_scenario("clam")


def test_a_paused_robot_does_not_count_in_a_comparison() -> None:
    """A robot that an event pauses is not compared: its task takes as long as the pause."""
    scenario = read_scenario(find_scenario("cloud-busy"))
    assert len(scenario.robots()) == 4
    assert scenario.compared() == ("robot",)
    assert replace(scenario, events=()).compared() == scenario.robots()
