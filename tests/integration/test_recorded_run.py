"""CI plays two recordings through the relay, with a real robot and a real server."""

import json
from pathlib import Path

import pytest

from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from tests.relays import read_record

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]


@pytest.mark.parametrize(
    ("name", "recorded", "tasks"),
    [
        ("link-plans", "5g-rural.csv", 40),
        ("link-frames", "3g-tram.csv", 20),
        ("link-stream", "5g-rural.csv", 600),
    ],
    ids=["5g-rural", "3g-tram", "stream"],
)
def test_a_recording_is_played(tmp_path: Path, name: str, recorded: str, tasks: int) -> None:
    """No task is lost or wrong, and the recording begins with the tasks; the files hold its hash."""
    scenario = read_scenario(find_scenario(name)).changed(tasks=tasks)
    played = play(scenario, tmp_path, quiet=True)
    played.check_robots()
    played.check_verdicts()
    summary = json.loads((tmp_path / "summary.json").read_text())
    shown = summary["recordings"]["cloud"]["up"]
    assert shown["file"] == recorded
    lines = read_record(tmp_path / "link.jsonl")
    begins = [line for line in lines if line.get("by") in ("flag", "recording")]
    assert [line["by"] for line in begins] == ["flag", "recording"]
    assert {line["up"]["recording"]["sha256"] for line in begins} == {shown["sha256"]}
