"""Plays the runs of an application, one after the other, and reads what their files know of each task.

`application_tables` computes figures from them.
"""

import importlib
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.application_tables import POLICIES, Known, Run
from offboard.common.tasks import Kind, kinds
from offboard.loadgen.compare.runs import play_once, rotated
from offboard.loadgen.play.run_files import ANSWERS, SUMMARY, TRACE
from offboard.loadgen.robot.answers import value_of
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario


@dataclass(frozen=True, slots=True)
class Planned:
    """A run that is to be played, and its folder."""

    scenario: Scenario
    policy: str
    out: Path


def planned(
    name: str, scenarios: Sequence[str], seeds: int, *, tasks: int | None, out: Path
) -> list[Planned]:
    """The runs of an application. Each policy comes first equally often."""
    found = []
    for n in range(seeds):
        for at, suffix in enumerate(scenarios):
            whole = read_scenario(find_scenario(f"{name.replace('_', '-')}-{suffix}")).changed(tasks=tasks)
            for policy in rotated(POLICIES, n + at):
                scenario = whole.changed(seed=whole.seed + n, policy=policy)
                folder = out / "runs" / scenario.name / f"{scenario.seed}-{policy}"
                found.append(Planned(scenario, policy, folder))
    return found


def find_kind(name: str) -> Kind:
    """The task of an application; a MissingExtra if its library is not installed."""
    module = importlib.import_module(f"examples.{name}")
    return next(one for one in kinds() if one.function.__module__ == module.__name__)


def play(one: Planned, kind: Kind) -> Run:
    """Play a run, unless it was played before, and read it."""
    played = play_once(one.scenario, one.out, "local")
    known = dict(_known(one.out, kind))
    return Run(one.scenario.name, one.scenario.seed, one.policy, played.outcome, known)


@dataclass(slots=True)
class Progress:
    """Says on stderr which run is next, and how long the rest may take."""

    total: int
    _number: int = 0
    _began_s: float = 0.0
    _seconds: list[float] = field(default_factory=list)  # of the runs that were really played

    def next(self, one: Planned) -> None:
        self._number += 1
        self._began_s = time.time()
        left = ""
        if self._seconds:
            each_s = sum(self._seconds) / len(self._seconds)
            left = f"; about {each_s * (self.total - self._number + 1) / 60:.0f} min left"
        what = f"{one.scenario.name}, seed {one.scenario.seed}, policy {one.policy}"
        print(f"run {self._number} of {self.total}: {what}{left}", file=sys.stderr, flush=True)

    def done(self, one: Planned) -> None:
        if (one.out / SUMMARY).stat().st_mtime >= self._began_s:
            self._seconds.append(time.time() - self._began_s)


def _known(out: Path, kind: Kind) -> Iterator[tuple[int, Known]]:
    by_id = {record["id"]: record for record in read_trace(out / TRACE)}
    for line in read_lines(out / ANSWERS):
        if (record := by_id.get(line["id"])) is not None:
            decision = record["decision"]
            yield (
                line["i"],
                Known(
                    size=record["size"],
                    work=_work(line["answer"], kind),
                    site=None if decision["both"] else decision["site"],
                    reason=decision["reason"],
                    predicted_s={site: one["predicted_s"] for site, one in record["sites"].items()},
                ),
            )


def _work(answer: dict[str, Any] | None, kind: Kind) -> float | None:
    """The work that an answer tells, if the answers file holds the answer whole."""
    return kind.work_of(value_of(answer, kind.types)) if answer and "frames" in answer else None
