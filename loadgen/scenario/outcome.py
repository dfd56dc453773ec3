"""What a played scenario left, task by task, and the figures that its checks and comparisons are about.

The robot wrote the files (docs/formats.md); what must hold of the figures is the business of `check`.
"""

import json
import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.errors import DataError
from offboard.loadgen.scenario.interval_coverage import Interval, intervals_of, late_seconds
from offboard.loadgen.table.score import quantile
from offboard.robot_client.records import trace
from offboard.robot_client.sites.runner import CLOUD

GROWTH_FROM = 1 / 3  # of a run: what a process needs to come to rest
READINGS_MIN = 6  # of what parts use, in the time that growth is looked for


@dataclass(frozen=True, slots=True)
class Answered:
    """One task that was answered; times in s since the first task was due.

    `wrong` says why the answer is wrong, `sites` are those it ran on, `intervals` those of their predictions;
    `server_s` is what the cloud's server itself took for it, without the way there and the queue.
    """

    i: int
    robot: str
    due_s: float
    ended_s: float
    error: str | None
    answer: Any
    chosen: str | None
    both: bool
    sites: tuple[str, ...]
    wrong: str | None = None
    intervals: tuple[Interval, ...] = ()
    server_s: float | None = None

    @property
    def response_s(self) -> float:
        """From when it was due until it was answered."""
        return self.ended_s - self.due_s


@dataclass(frozen=True, slots=True)
class Reference:
    """One task that was run again on each site alone, and where the policy had sent it.

    `seconds` are those of the sites that answered, `given_up_s` of those that did not.
    """

    i: int
    chosen: str
    both: bool
    seconds: Mapping[str, float]
    given_up_s: Mapping[str, float]

    @property
    def oracle_s(self) -> float:
        """The time of the faster site."""
        return min(self.seconds.values())

    @property
    def sent_s(self) -> float:
        """The time where the policy sent it; after what was given up there, of the site that answered."""
        if self.both:
            return self.oracle_s
        if self.chosen in self.seconds:
            return self.seconds[self.chosen]
        return self.given_up_s.get(self.chosen, 0.0) + self.oracle_s


@dataclass(frozen=True, slots=True)
class Reading:
    """What a part used at a time."""

    at_s: float
    part: str
    memory_bytes: int
    handles: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """All of a run, or of its tasks from one to another. `asked` counts each robot's tasks.

    `outage`: how many the first robot had answered when the link fell silent, and when it was back for good.
    """

    asked: Mapping[str, int]
    answered: Sequence[Answered]
    references: Sequence[Reference] = ()
    readings: Sequence[Reading] = ()
    deadline_s: float | None = None
    outage: tuple[int, int] | None = None

    def between(self, first: int, last: int | None = None) -> "Outcome":
        """The part from task `first` up to, and without, task `last` of each robot."""
        last = max(self.asked.values(), default=0) if last is None else last
        asked = {robot: max(0, min(last, tasks) - first) for robot, tasks in self.asked.items()}
        kept = [one for one in self.answered if first <= one.i < last]
        references = [one for one in self.references if first <= one.i < last]
        return replace(self, asked=asked, answered=kept, references=references)

    def of(self, robots: Collection[str]) -> "Outcome":
        """What these robots did."""
        asked = {robot: tasks for robot, tasks in self.asked.items() if robot in robots}
        return replace(self, asked=asked, answered=[one for one in self.answered if one.robot in robots])


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of an outcome: its unit, in words what it is, and how it is computed (None: undefined).

    `needs` names the setting of the workload without which there is no such figure.
    """

    unit: str
    about: str
    compute: Callable[[Outcome], float | None] = field(repr=False)
    needs: str | None = None


def _lost(run: Outcome) -> float:
    return sum(run.asked.values()) - len({(one.robot, one.i) for one in run.answered})


def _wrong(run: Outcome) -> float:
    return sum(one.wrong is not None for one in run.answered)


def _failed(run: Outcome) -> float:
    return sum(one.error is not None for one in run.answered)


def _mean_ms(run: Outcome) -> float | None:
    return 1e3 * sum(one.response_s for one in run.answered) / len(run.answered) if run.answered else None


def _quantile_ms(percent: int) -> Callable[[Outcome], float | None]:
    def compute(run: Outcome) -> float | None:
        times = np.array([one.response_s for one in run.answered])
        return 1e3 * float(quantile(times, percent)) if len(times) else None

    return compute


def _percent(of: Callable[[Outcome], Sequence[bool]]) -> Callable[[Outcome], float | None]:
    def compute(run: Outcome) -> float | None:
        facts = of(run)
        return 100 * sum(facts) / len(facts) if facts else None

    return compute


def _late(run: Outcome) -> list[bool]:
    assert run.deadline_s is not None
    return [one.response_s > run.deadline_s for one in run.answered]


def _in_the_cloud(run: Outcome) -> list[bool]:
    return [one.chosen == CLOUD for one in run.answered if one.chosen and not one.both]


def _twice(run: Outcome) -> list[bool]:
    return [len(one.sites) > 1 for one in run.answered if one.sites]


def _right_site(run: Outcome) -> list[bool]:
    known = [one for one in run.references if len(one.seconds) > 1 and not one.both]
    return [one.chosen == min(one.seconds, key=one.seconds.__getitem__) for one in known]


def _time_over_oracle(run: Outcome) -> float | None:
    oracle_s = sum(one.oracle_s for one in run.references)
    return sum(one.sent_s for one in run.references) / oracle_s if oracle_s else None


def _regret_ms(run: Outcome) -> float | None:
    regrets = [one.sent_s - one.oracle_s for one in run.references]
    return 1e3 * sum(regrets) / len(regrets) if regrets else None


def _growth(of: Callable[[Reading], float]) -> Callable[[Outcome], float | None]:
    """By how many percent the part that grew most did, from the first to the last third of what is looked at.

    Of each third the median: one reading that is high is no growth.
    """

    def compute(run: Outcome) -> float | None:
        end_s = max((one.at_s for one in run.readings), default=0.0)
        grown = []
        for part in {one.part for one in run.readings}:
            mine = [of(one) for one in run.readings if one.part == part and one.at_s >= GROWTH_FROM * end_s]
            third = len(mine) // 3
            if len(mine) >= READINGS_MIN:
                first, last = statistics.median(mine[:third]), statistics.median(mine[-third:])
                grown.append(100 * (last / first - 1))
        return max(grown, default=None)

    return compute


FIGURES: dict[str, Figure] = {
    "lost": Figure("tasks", "asked and never answered", _lost),
    "wrong": Figure("tasks", "answered wrongly", _wrong, "jump"),
    "failed": Figure("tasks", "answered with an error", _failed),
    "mean_ms": Figure("ms", "mean time from when a task is due to its answer", _mean_ms),
    "p95_ms": Figure("ms", "95 % of tasks are answered within", _quantile_ms(95)),
    "p99_ms": Figure("ms", "99 % of tasks are answered within", _quantile_ms(99)),
    "late_percent": Figure("%", "tasks answered after their deadline", _percent(_late), "deadline"),
    "cloud_percent": Figure(
        "%", "tasks sent to the cloud, of those sent to one site", _percent(_in_the_cloud)
    ),
    "twice_percent": Figure("%", "tasks that ran on two sites", _percent(_twice)),
    "accuracy_percent": Figure(
        "%", "referenced tasks sent to the faster site", _percent(_right_site), "reference"
    ),
    "time_over_oracle": Figure(
        "times",
        "time of the referenced tasks where they were sent, over that of the faster site",
        _time_over_oracle,
        "reference",
    ),
    "regret_ms": Figure("ms", "mean of what the faster site would have saved", _regret_ms, "reference"),
    "memory_growth_percent": Figure(
        "%", "growth of the memory of the part that grew most", _growth(lambda one: one.memory_bytes)
    ),
    "handles_growth_percent": Figure(
        "%",
        "growth of the open files and sockets of the part that grew most",
        _growth(lambda one: one.handles),
    ),
}


def read_answered(answers: Path, records: Path, robot: str) -> list[Answered]:
    """The answers of one robot, joined with the trace by id; without a line there, no site is known."""
    by_id = {record["id"]: record for record in trace.read(records)} if records.is_file() else {}
    late = late_seconds(by_id.values())
    found = []
    for line in read_lines(answers):
        record = by_id.get(line["id"], {})
        decision, executions = record.get("decision", {}), record.get("executions", ())
        found.append(
            Answered(
                i=line["i"],
                robot=robot,
                due_s=line["due_s"],
                ended_s=line["ended_s"],
                error=line["error"],
                answer=line["answer"],
                chosen=decision.get("site"),
                both=decision.get("both", False),
                sites=tuple(one["site"] for one in executions),
                intervals=intervals_of(record, late),
                server_s=next(
                    (one["run_s"] for one in executions if one["site"] == CLOUD and one["ok"]), None
                ),
            )
        )
    return found


def read_references(path: Path) -> list[Reference]:
    """Those that a site answered."""
    found = []
    for line in read_lines(path):
        seconds = {site: run["seconds"] for site, run in line["sites"].items() if run["ok"]}
        given_up_s = {site: run["seconds"] for site, run in line["sites"].items() if not run["ok"]}
        if seconds:
            found.append(Reference(line["i"], line["chosen"], line["both"], seconds, given_up_s))
    return found


def read_readings(path: Path) -> list[Reading]:
    return [Reading(**line) for line in read_lines(path)]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a file of JSON Lines; none where there is no file, and a torn last one is left out."""
    if not path.is_file():
        return []
    found = []
    for number, line in enumerate(path.read_bytes().split(b"\n")[:-1], 1):
        try:
            found.append(json.loads(line))
        except ValueError as error:
            raise DataError(f"{path}:{number}: not a JSON line: {error}") from None
    return found
