"""Scenarios played for real: their checks are computed, and the same seed asks the same of the same link."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.play import play_scenario as player
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.play.run_files import EVENTS, TRACE
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.robot_client.records import trace
from tests.chaos.plays import IN_CONTAINERS, ON_LOOPBACK, SOAK_TASKS

pytestmark = pytest.mark.timeout(600)


@pytest.mark.parametrize(
    ("testbed", "name"),
    [
        *(pytest.param("local", name, marks=pytest.mark.integration) for name in ON_LOOPBACK),
        *(pytest.param("docker", name, marks=pytest.mark.compose) for name in IN_CONTAINERS),
    ],
)
def test_a_scenario_is_played_and_judged(
    request: pytest.FixtureRequest, tmp_path: Path, testbed: str, name: str
) -> None:
    """By the published rule: every check has a figure, nothing is lost and nothing wrong."""
    if testbed == "docker":
        request.getfixturevalue("engine")
    scenario = read_scenario(find_scenario(name))
    played = play(scenario, tmp_path, testbed, quiet=True)
    played.check_robots()
    print(*played.verdicts, sep="\n")
    assert len(played.verdicts) == len(scenario.checks)
    assert all(verdict.value is not None for verdict in played.verdicts)
    figures = player.figures(played.outcome, scenario)
    assert (figures["lost"], figures["wrong"]) == (0, 0)
    happened = read_lines(tmp_path / EVENTS)
    assert len(happened) == len(scenario.timeline())
    assert all(event["happened_s"] is not None for event in happened)
    summary = json.loads((tmp_path / player.SUMMARY).read_text())
    assert [check["holds"] for check in summary["checks"]] == [one.holds for one in played.verdicts]


@pytest.mark.integration
def test_one_seed_is_one_run(tmp_path: Path) -> None:
    """Twice the same scenario and seed: the same tasks, sizes, events and draws of the link."""
    scenario = read_scenario(find_scenario("lossy")).changed(tasks=24, policy="cloud")
    runs = []
    for name in ("a", "b"):
        out = tmp_path / name
        play(scenario, out, quiet=True).check_robots()
        records = list(trace.read(out / TRACE))
        sizes = [record["size"] for record in records]
        answers = [{key: line[key] for key in ("i", "answer")} for line in read_lines(out / "answers.jsonl")]
        events = [{**event, "happened_s": 0, "took_s": 0} for event in read_lines(out / EVENTS)]
        runs.append((sizes, answers, events, drawn(out / "link.jsonl")))
    one, other = runs
    assert one[:3] == other[:3]
    common = one[3].keys() & other[3].keys()
    assert len(common) > 100
    assert {at: one[3][at] for at in common} == {at: other[3][at] for at in common}
    assert any(stall_ms > 0 for _, stall_ms in one[3].values())


def drawn(truth: Path) -> dict[Any, tuple[float, float]]:
    """Jitter and stall of each segment, by connection, direction and number.

    How many chunks a segment comes in is a matter of the moment; the first of them has its stall.
    """
    found: dict[Any, tuple[float, float]] = {}
    for line in read_lines(truth):
        if line["what"] == "chunk" and line["bytes"]:
            key = line["connection"], line["direction"], line["segment"]
            found.setdefault(key, (line["drawn_ms"], line["stall_ms"]))
    return found


@pytest.mark.integration
def test_a_while_of_faults_costs_nothing(tmp_path: Path) -> None:
    """The soak, shortened: twenty tasks a second and random faults; none lost, none wrong, nothing grows."""
    played = play(read_scenario(find_scenario("soak")).changed(tasks=SOAK_TASKS), tmp_path, quiet=True)
    played.check_robots()
    print(*played.verdicts, sep="\n")
    assert [str(one) for one in played.verdicts if not one.holds] == []


@pytest.mark.integration
def test_an_event_in_vain_is_skipped_and_says_why(tmp_path: Path) -> None:
    """What cannot happen to a part as it is does not end the run."""
    events = (
        Event("start", "cloud", at_task=2),
        Event("resume", "cloud", at_task=4),
        Event("pause", "cloud", at_task=6),
        Event("pause", "cloud", at_task=8),
        Event("kill", "cloud", at_task=10),
        Event("hogs", {"cloud": 1}, at_task=12),
        Event("kill", "cloud", at_task=1000),
    )
    scenario = read_scenario(find_scenario("calm")).changed(tasks=30)
    played = play(replace(scenario, events=events, checks=()), tmp_path, quiet=True)
    assert player.figures(played.outcome, scenario)["lost"] == 0
    happened = read_lines(tmp_path / EVENTS)
    assert [event.get("skipped") for event in happened] == [
        "cloud was running",
        "cloud was not paused",
        None,
        "cloud was paused",
        None,
        "cloud was not running",
        None,
    ]
    assert happened[-1]["happened_s"] is None
