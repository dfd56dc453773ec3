"""Several real servers on loopback: each has its own link, and a robot goes on when one of them dies."""

import json
from pathlib import Path

import pytest

from offboard.loadgen.play.play_scenario import figures, play
from offboard.loadgen.scenario.outcome_figures import site_percent
from offboard.loadgen.scenario.scenario_file import read_scenario

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]
COMES = """[[event]]
at_task = 8
start = "edge"
[[event]]
at_task = 24
stop = "edge"
"""
SCENARIO = """name = "pair"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["uniform:60000:90000"]
tasks = 40
reference = 10
[robot]
cpus = 0.1
[link]
delay_ms = 60
[[cloud]]
name = "cloud"
[[cloud]]
name = "edge"
link = { delay_ms = 1 }
[[event]]
at_task = 20
kill = "edge"
"""


def test_the_near_server_is_used_until_it_dies(tmp_path: Path) -> None:
    """No task is lost or wrong, the far server takes over, and each relay has its own record."""
    path = tmp_path / "pair.toml"
    path.write_text(SCENARIO)
    scenario = read_scenario(path)
    played = play(scenario, tmp_path / "out", quiet=True)
    played.check_robots()
    found = figures(played.outcome, scenario)
    assert (found["lost"], found["wrong"], found["failed"]) == (0, 0, 0)
    before, after = played.outcome.between(8, 20), played.outcome.between(25)
    assert (site_percent(before, "edge") or 0) >= 60
    assert (site_percent(after, "edge"), site_percent(after, "cloud")) == (0, pytest.approx(100, abs=30))
    # The reference of the last task before the death of the server may come after it.
    references = [one for one in played.outcome.references if one.i < 19]
    assert all(one.seconds.keys() == {"onboard", "cloud", "edge"} for one in references)
    assert {one.name for one in (tmp_path / "out").glob("link*.jsonl")} == {"link.jsonl", "link-edge.jsonl"}
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["site_shares"].keys() == {"onboard", "cloud", "edge"}


def test_a_server_that_an_event_starts_can_be_stopped(tmp_path: Path) -> None:
    """Both events happen, its memory is read, and it is used only between them."""
    path = tmp_path / "comes.toml"
    path.write_text(SCENARIO.partition("[[event]]")[0] + COMES)
    played = play(read_scenario(path), tmp_path / "out", quiet=True)
    played.check_robots()
    events = map(json.loads, (tmp_path / "out" / "events.jsonl").read_text().splitlines())
    assert [one.get("skipped") for one in events] == [None, None]
    readings = map(json.loads, (tmp_path / "out" / "usage.jsonl").read_text().splitlines())
    assert "edge" in {one["part"] for one in readings}
    assert (site_percent(played.outcome.between(12, 24), "edge") or 0) > 0
    assert site_percent(played.outcome.between(32), "edge") == 0  # a few tasks pass until it has ended
