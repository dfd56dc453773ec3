"""Comparing policies over a folder of recordings: what is played, and what the tables say."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.compare.compare import run_compare
from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.recording_table import (
    Comparison,
    family_table,
    recording_table,
    sentence,
    tables,
)
from offboard.loadgen.compare.recordings import (
    Figures,
    Taken,
    at_rate,
    check_events,
    figures_of,
    find_recordings,
    from_link,
    over,
)
from offboard.loadgen.scenario.outcome import Answered, Outcome, Reference
from offboard.loadgen.scenario.scenario_file import LINKS, find_scenario, read_scenario
from tests.mazes import warm

warm()  # compiles before the clock of any test runs
POLICIES = ("default", "onboard", "cloud")
CONFIG = CompareConfig(policies=POLICIES, simulate=True, seeds=1)


def recording(folder: Path, name: str, text: str = "t_s,rtt_ms\n0,30\n9,20\n") -> Path:
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def figures(name: str, family: str = "5g", p99: float = 0.2, **means: float) -> Figures:
    """Means in seconds by policy; the P99 of all is 0.2 s, except that of the default."""
    taken = {
        policy: Taken(mean, p99 if policy == "default" else 0.2, 1.1, 50.0, tasks=300, lost=0)
        for policy, mean in means.items()
    }
    return Figures(family, name, taken)


def comparison(*found: Figures) -> Comparison:
    return Comparison("link-plans", 300, "one at a time", found, {"5g": "100 Mbit/s up, 100 Mbit/s down"})


def of_default(*found: Figures) -> list[Any]:
    """The lines of the default in the table of families."""
    return [one for one in family_table(comparison(*found), CONFIG).lines if one.policy == "default"]


def test_a_family_is_a_folder(tmp_path: Path) -> None:
    """Files of the folder itself have its name as their family; two files of mahimahi are one recording."""
    recording(tmp_path, "a.csv")
    recording(tmp_path, "3g/b.csv")
    recording(tmp_path, "3g/SOURCE.md")
    recording(tmp_path, "lte/drive/c.up", "1\n")
    recording(tmp_path, "lte/drive/c.down", "1\n")
    found = {(one.family, one.name): list(one.files) for one in find_recordings(tmp_path)}
    assert found == {
        ("3g", "b"): ["recording"],
        (tmp_path.name, "a"): ["recording"],
        ("lte/drive", "c"): ["down_recording", "up_recording"],
    }


def test_a_folder_that_cannot_be_played_is_refused(tmp_path: Path) -> None:
    """One line names the folder, or the file that is missing."""
    with pytest.raises(ConfigError, match=r"--recordings: .*gone is not a folder"):
        find_recordings(tmp_path / "gone")
    with pytest.raises(ConfigError, match=r"--recordings: .* has no file that ends in \.csv"):
        find_recordings(tmp_path)
    recording(tmp_path, "c.up", "1\n")
    with pytest.raises(DataError, match=r"c\.up: c\.down is missing"):
        find_recordings(tmp_path)


def test_the_seed_draws_the_start(tmp_path: Path) -> None:
    """The same seed begins at the same place of a recording; the other conditions stay."""
    recording(tmp_path, "a.csv")
    (link,) = find_recordings(tmp_path)
    scenario = read_scenario(find_scenario("link-plans"))
    starts = [over(scenario, link, seed).link["recording_from_s"] for seed in (1, 1, 2)]
    assert starts[0] == starts[1] != starts[2]
    assert all(0 <= start < 18 for start in starts)
    played = over(scenario, link, 7)
    assert (played.seed, played.link["recording"]) == (7, tmp_path / "a.csv")
    assert played.link["bandwidth_mbps"] == scenario.link["bandwidth_mbps"]
    assert from_link(played) == "100 Mbit/s up, 100 Mbit/s down"


def test_an_event_that_changes_what_is_recorded_is_refused(tmp_path: Path) -> None:
    """Before anything is played."""
    recording(tmp_path, "a.csv", "t_s,mbps\n0,1\n")
    (link,) = find_recordings(tmp_path)
    with pytest.raises(ConfigError, match=r"scenario bandwidth/.*: event .*: up\.bandwidth_mbps: cannot be"):
        check_events(over(read_scenario(find_scenario("bandwidth")), link, 1))
    check_events(over(read_scenario(find_scenario("outage")), link, 1))


def test_tasks_can_come_at_a_rate() -> None:
    """Whatever the answers; without a rate the scenario stays as it is."""
    scenario = read_scenario(find_scenario("link-plans"))
    assert at_rate(scenario, None) is scenario
    assert at_rate(scenario, 4.0).workload == replace(scenario.workload, arrivals="constant", rate=4.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rate": 4.0}, "--rate: 4 needs --recordings"),
        ({"recordings": Path(), "policies": ("default", "cloud")}, "--recordings needs onboard and cloud"),
    ],
)
def test_settings_that_need_each_other(settings: dict[str, Any], message: str) -> None:
    """One line names what is missing."""
    with pytest.raises(ConfigError, match=message):
        CompareConfig(**settings)


def test_figures_are_those_of_the_answers() -> None:
    """All seeds together: mean, P99, time over oracle, lost tasks. A policy without answers is refused."""
    answered = [
        Answered(i, "robot", i, i + 0.1 * (i + 1), None, None, "cloud", False, ("cloud",)) for i in range(3)
    ]
    reference = Reference(0, "cloud", False, {"cloud": 0.2, "onboard": 0.1}, {})
    run = Outcome({"robot": 4}, answered, references=[reference])
    taken = figures_of("5g", "a", {"default": [run, run]}).taken["default"]
    assert (taken.mean_s, taken.over_oracle) == (pytest.approx(0.2), pytest.approx(2.0))
    assert (taken.tasks, taken.lost, taken.cloud_percent) == (6, 2, 100.0)
    assert taken.p99_s == pytest.approx(0.3, abs=0.02)
    with pytest.raises(DataError, match="5g/a: cloud answered no task"):
        figures_of("5g", "a", {"cloud": [Outcome({"robot": 4}, [])]})


def test_the_better_constant_is_that_of_the_recording() -> None:
    """Each recording is divided by its own; the family gets the geometric mean, and names the worst one."""
    found = [
        figures("a", default=0.1, onboard=0.1, cloud=0.2),
        figures("b", default=0.4, onboard=0.3, cloud=0.1, p99=0.3),
    ]
    line = family_table(comparison(*found), CONFIG).lines[0]
    assert (line.policy, line.recordings, line.worst) == ("default", 2, "b")
    assert line.mean_ratio == pytest.approx(2.0)  # of 1 and 4
    assert line.p99_ratio == pytest.approx(1.5**0.5)
    assert (line.worst_mean, line.behind, line.over_oracle) == (pytest.approx(4.0), 1, pytest.approx(1.1))
    behind = recording_table(comparison(*found), CONFIG).lines
    assert [(one.recording, one.better, one.usable) for one in behind] == [("5g/b", "cloud", "yes")]


def test_a_recording_is_the_unit_of_an_interval() -> None:
    """From ten recordings on there is one; it has no width if all recordings have the same ratio."""
    few = [figures(str(n), default=0.1, onboard=0.1, cloud=0.2) for n in range(9)]
    assert [one.bound for one in of_default(*few)] == [""]
    many = [figures(str(n), default=0.1 * (1 + n % 2), onboard=0.1, cloud=0.2) for n in range(20)]
    middle, low, high = (one.mean_ratio for one in of_default(*many))
    assert middle == pytest.approx(2**0.5)
    assert 1 < low < middle < high < 2
    assert {round(one.mean_ratio, 9) for one in of_default(*few, *few)} == {1.0}


def test_a_sentence_says_it_in_words() -> None:
    """Ahead, level and behind by family, and the worst recording."""
    families = {
        "5g": [figures("a", default=0.09, onboard=0.1, cloud=0.2)],
        "3g": [figures("b", default=0.1, onboard=0.1, cloud=0.2)],
        "video": [figures("c", "video", default=0.12, onboard=0.1, cloud=0.2)],
    }
    assert sentence("default", families) == (
        "default against the better constant in 3 families: ahead in 1 (by 10 %), level in 1, behind in 1"
        " (by 20 %: video); in its worst recording, video/c, it is 20 % behind."
    )


def test_every_format_can_be_written() -> None:
    """CSV and JSON hold every recording and policy; Markdown ends with the sentence."""
    one = comparison(figures("a", default=0.2, onboard=0.1, cloud=0.2))
    assert tables([one], CONFIG).rstrip().endswith("it is 100 % behind.")
    (families, each) = json.loads(tables([one], replace(CONFIG, format="json")))["tables"]
    assert len(families["scores"]) == len(each["scores"]) == 3
    assert "not recorded, and therefore taken from [link]: 100 Mbit/s up" in families["notes"][0]
    assert tables([one], replace(CONFIG, format="csv")).count("\n\n") == 1
    assert r"\begin{table*}" in tables([one], replace(CONFIG, format="latex"))


def test_the_shipped_recordings_can_be_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A family of shipped recordings in simulation, one at a time and at a rate."""
    for rate in (None, 4.0):
        config = replace(
            CONFIG, recordings=LINKS / "3g", tasks=20, rate=rate, jobs=1, format="json", out=tmp_path
        )
        assert run_compare(["link-plans"], config) == 0
        families, each = json.loads(capsys.readouterr().out)["tables"]
        assert [line["recordings"] for line in families["scores"]] == [4, 4, 4]
        assert {line["family"] for line in families["scores"]} == {"3g"}
        assert len(each["scores"]) == 12
        assert all((line["over_oracle"] is None) == (rate is not None) for line in each["scores"])
