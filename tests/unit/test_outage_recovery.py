"""Recovery after an outage: the tasks until the cloud has its usual share again, counted by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.site_shares import median_recovery, read_outage, recovery_tasks


def run(sites: str, outage: tuple[int, int] | None = (20, 30)) -> Outcome:
    """A run with one letter for each task: c cloud, o onboard, b both sites."""
    names = {"c": "cloud", "o": "onboard", "b": "onboard"}
    tasks = [
        Answered(i, "robot", i, i + 0.1, None, None, names[letter], letter == "b", ("onboard",))
        for i, letter in enumerate(sites)
    ]
    return Outcome({"robot": len(sites)}, tasks, outage=outage)


@pytest.mark.parametrize(
    ("sites", "tasks"),
    [
        ("c" * 60, 0),  # the share never dropped
        ("c" * 20 + "o" * 10 + "c" * 30, 9),  # nine of the last ten: 90 %, 100 % before
        ("c" * 20 + "o" * 10 + "b" * 5 + "c" * 25, 14),  # tasks on both sites count in no share
        ("co" * 10 + "o" * 15 + "co" * 20, 12),  # 50 % before, so 40 % is enough
        ("c" * 20 + "o" * 10 + "o" * 6 + "c" * 9, 15),
        ("c" * 20 + "o" * 40, math.inf),
        ("c" * 20 + "o" * 10 + "c" * 8, math.inf),  # the run ended too early
    ],
)
def test_recovery_counts_the_tasks_after_the_outage(sites: str, tasks: float) -> None:
    """Recovered means: the share over ten tasks differs by at most ten points from the share before."""
    found = recovery_tasks(run(sites))
    assert found == tasks


def test_recovery_is_undefined_without_an_outage_or_a_share_before_it() -> None:
    """There is none without an outage, with too few tasks before it, or with a share of at most 10 %."""
    assert recovery_tasks(run("c" * 60, outage=None)) is None
    assert recovery_tasks(run("c" * 60, outage=(9, 20))) is None
    assert recovery_tasks(run("oooooooooc" * 6)) is None


def test_tasks_of_other_robots_do_not_count() -> None:
    """Only tasks of the first robot count, because the outage is given in its tasks."""
    whole = run("c" * 20 + "o" * 10 + "c" * 30)
    others = [replace(one, robot="robot-2", chosen="onboard") for one in whole.answered]
    assert recovery_tasks(replace(whole, answered=[*whole.answered, *others])) == 9


def test_the_median_is_over_runs_and_a_note_counts_runs_without_recovery() -> None:
    """A run that never recovered counts as infinite; if the median is infinite, only the note remains."""
    back, never = run("c" * 20 + "o" * 10 + "c" * 30), run("c" * 20 + "o" * 40)
    left = run("c" * 60)
    assert median_recovery([back, left, back]) == (9, "")
    assert median_recovery([back, never, left]) == (9, "the cloud's share never came back in 1 of 3 runs")
    assert median_recovery([never, never, left]) == (
        None,
        "the cloud's share never came back in 2 of 3 runs",
    )
    assert median_recovery([run("c" * 60, outage=None)]) == (None, "")


@pytest.mark.parametrize(
    ("events", "outage"),
    [
        ([({"link": {"outage": True}}, 50), ({"link": {"outage": False}}, 64)], (50, 64)),
        ([({"cut": "cloud"}, 5), ({"join": "cloud"}, 9)], (5, 9)),
        ([({"link": {"up": {"outage": True}}}, 5), ({"link": {"up": {"outage": False}}}, 9)], (5, 9)),
        (  # a flapping link is back for good after its last outage
            [
                ({"link": {"outage": True}}, 4),
                ({"link": {"outage": False}}, 6),
                ({"link": {"outage": True}}, 8),
                ({"link": {"outage": False}}, 10),
            ],
            (4, 10),
        ),
        ([({"link": {"outage": True}}, 4), ({"link": {"delay_ms": 3}}, 6)], None),
        ([({"kill": "cloud"}, 4), ({"start": "cloud"}, 6)], None),
        ([], None),
    ],
)
def test_the_outage_is_read_from_the_events(
    events: list[tuple[dict[str, object], int]], outage: tuple[int, int] | None, tmp_path: Path
) -> None:
    """The outage lasts from the first silence to the end of the last one, counted in answered tasks."""
    path = tmp_path / "events.jsonl"
    lines = [{"at_task": 1, **event, "happened_s": 1.0, "answered": n} for event, n in events]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert read_outage(path) == outage


def test_an_event_that_did_not_happen_is_no_outage(tmp_path: Path) -> None:
    """An event that was never due, or was skipped, is no outage."""
    never = {"at_task": 90, "link": {"outage": True}, "happened_s": None}
    vain = {"at_task": 9, "cut": "robot", "happened_s": 1.0, "answered": 9, "skipped": "it had ended"}
    back = {"at_task": 12, "join": "robot", "happened_s": 2.0, "answered": 12}
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (vain, back, never)))
    assert read_outage(tmp_path / "events.jsonl") is None
