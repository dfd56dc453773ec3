"""When the cloud has its share of the tasks again after an outage, by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.loadgen.scenario.outage_recovery import median_recovery, read_outage, recovery_tasks
from offboard.loadgen.scenario.outcome import Answered, Outcome


def run(sites: str, outage: tuple[int, int] | None = (20, 30)) -> Outcome:
    """A letter a task: c cloud, o onboard, b both."""
    names = {"c": "cloud", "o": "onboard", "b": "onboard"}
    tasks = [
        Answered(i, "robot", i, i + 0.1, None, None, names[letter], letter == "b", ("onboard",))
        for i, letter in enumerate(sites)
    ]
    return Outcome({"robot": len(sites)}, tasks, outage=outage)


@pytest.mark.parametrize(
    ("sites", "tasks"),
    [
        ("c" * 60, 0),  # it never left
        ("c" * 20 + "o" * 10 + "c" * 30, 9),  # nine of the last ten: 90 % of 100 %
        ("c" * 20 + "o" * 10 + "b" * 5 + "c" * 25, 14),  # both tell nothing, and take their time
        ("co" * 10 + "o" * 15 + "co" * 20, 12),  # 40 % is enough of 50 %: the fourth after five onboard
        ("c" * 20 + "o" * 10 + "o" * 6 + "c" * 9, 15),
        ("c" * 20 + "o" * 40, math.inf),
        ("c" * 20 + "o" * 10 + "c" * 8, math.inf),  # it was over too soon
    ],
)
def test_recovery_counts_the_tasks_after_the_outage(sites: str, tasks: float) -> None:
    """Until the share over ten tasks is within ten points of that before: by hand."""
    found = recovery_tasks(run(sites))
    assert found == tasks


def test_without_an_outage_or_a_share_before_there_is_no_recovery() -> None:
    """Blank: no outage, too few tasks before it, or a share that nobody could miss."""
    assert recovery_tasks(run("c" * 60, outage=None)) is None
    assert recovery_tasks(run("c" * 60, outage=(9, 20))) is None
    assert recovery_tasks(run("oooooooooc" * 6)) is None


def test_tasks_of_other_robots_do_not_count() -> None:
    """The outage is known in tasks of the first robot."""
    whole = run("c" * 20 + "o" * 10 + "c" * 30)
    others = [replace(one, robot="robot-2", chosen="onboard") for one in whole.answered]
    assert recovery_tasks(replace(whole, answered=[*whole.answered, *others])) == 9


def test_the_median_is_over_runs_and_says_who_never_recovered() -> None:
    """A run that did not counts as infinite; where the median is, only the note tells."""
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
        (  # a flapping link is back with its last outage
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
def test_an_outage_is_read_from_the_events_as_they_happened(
    events: list[tuple[dict[str, object], int]], outage: tuple[int, int] | None, tmp_path: Path
) -> None:
    """From the first silence to the last one's end, in tasks that were answered by then."""
    path = tmp_path / "events.jsonl"
    lines = [{"at_task": 1, **event, "happened_s": 1.0, "answered": n} for event, n in events]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert read_outage(path) == outage


def test_an_event_that_did_not_happen_is_no_outage(tmp_path: Path) -> None:
    """One that was never due, or came in vain."""
    never = {"at_task": 90, "link": {"outage": True}, "happened_s": None}
    vain = {"at_task": 9, "cut": "robot", "happened_s": 1.0, "answered": 9, "skipped": "it had ended"}
    back = {"at_task": 12, "join": "robot", "happened_s": 2.0, "answered": 12}
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (vain, back, never)))
    assert read_outage(tmp_path / "events.jsonl") is None
