"""Recordings of links in a folder, a scenario over one of them, and what each policy took over it.

`compare` plays the scenarios; `recording_table` computes the figures by family.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.compare.compare_settings import CONSTANTS
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.robot.workload import CONSTANT
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.table.table_two_figures import quantile
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

RECORDINGS_MAX = 10_000
CSV, UP, DOWN = ".csv", ".up", ".down"
USABLE = 2.0  # a link is usable if `cloud` takes at most this many times as long as `onboard`
MEAN_BEHIND, P99_BEHIND = 1.03, 1.10


@dataclass(frozen=True, slots=True)
class RecordedLink:
    """A recording of a folder: its family, its name and its `files`, by their names in `[link]`."""

    family: str
    name: str
    files: Mapping[str, Path]


def find_recordings(folder: Path) -> list[RecordedLink]:
    """The CSV files below a folder, and the pairs NAME.up and NAME.down; the family is their folder."""
    if not folder.is_dir():
        raise ConfigError(f"--recordings: {folder} is not a folder")
    found: dict[tuple[str, str], dict[str, Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix not in (CSV, UP, DOWN):
            continue
        place = path.parent.relative_to(folder).as_posix()
        family = folder.resolve().name if place == "." else place
        key = "recording" if path.suffix == CSV else f"{path.suffix[1:]}_recording"
        found.setdefault((family, path.stem), {})[key] = path.resolve()
        if len(found) > RECORDINGS_MAX:
            raise ConfigError(f"--recordings: {folder} has more than {RECORDINGS_MAX} recordings")
    for (_, name), files in found.items():
        for key, path in files.items():
            if key != "recording" and len(files) == 1:
                other = DOWN if path.suffix == UP else UP
                raise DataError(f"{path}: {name}{other} is missing; mahimahi has one file for each direction")
    if not found:
        raise ConfigError(f"--recordings: {folder} has no file that ends in {CSV}, or in {UP} and {DOWN}")
    return [RecordedLink(family, name, files) for (family, name), files in found.items()]


def over(scenario: Scenario, recorded: RecordedLink, seed: int) -> Scenario:
    """The scenario over a recording, from a start that the seed draws; at its end it starts again."""
    link: dict[str, Any] = {key: value for key, value in scenario.link.items() if "recording" not in key}
    link |= recorded.files
    played = LinkFlags(**link).link
    place = Random(f"{seed}/{recorded.family}/{recorded.name}").random()
    shortest_s = min(
        one.recording.recording.length_s for one in (played.up, played.down) if one.recording is not None
    )
    link["recording_from_s"] = place * shortest_s
    servers = tuple(
        replace(one, link={key: value for key, value in one.link.items() if "recording" not in key})
        for one in scenario.servers
    )
    name = f"{scenario.name}/{recorded.family}/{recorded.name}"
    return replace(scenario, name=name, seed=seed, link=link, servers=servers)


def check_events(scenario: Scenario) -> None:
    """ConfigError if an event of the scenario changes what is recorded."""
    for event in scenario.timeline():
        if event.action == "link":
            for flags in scenario.links().values():
                try:
                    LinkFlags(**flags).link.changed(event.value)
                except ConfigError as error:
                    raise ConfigError(f"scenario {scenario.name}: event {event.shown()}: {error}") from None


def at_rate(scenario: Scenario, rate: float | None) -> Scenario:
    """The scenario with this number of tasks a second, whatever the answers; None: as it is."""
    if rate is None:
        return scenario
    workload = replace(scenario.workload, arrivals=CONSTANT, rate=rate, reference=0)
    workload.robot(scenario.seed)
    return replace(scenario, workload=workload)


def from_link(scenario: Scenario) -> str:
    """What the recording does not hold, and the scenario says instead."""
    return str(LinkFlags(**scenario.link).link.told()).partition("recorded: ")[2]


@dataclass(frozen=True, slots=True)
class Taken:
    """The tasks of one policy over one recording, all seeds together."""

    mean_s: float
    p99_s: float
    over_oracle: float | None
    cloud_percent: float
    tasks: int
    lost: int


@dataclass(frozen=True, slots=True)
class Figures:
    """What each policy took over one recording."""

    family: str
    recording: str
    taken: Mapping[str, Taken]

    @property
    def better(self) -> str:
        """The constant policy with the smaller mean."""
        return min(CONSTANTS, key=lambda name: self.taken[name].mean_s)

    @property
    def usable(self) -> bool:
        return self.taken[CLOUD].mean_s <= USABLE * self.taken[ONBOARD].mean_s

    def mean_ratio(self, policy: str) -> float:
        return self.taken[policy].mean_s / self.taken[self.better].mean_s

    def p99_ratio(self, policy: str) -> float:
        """The P99 of a policy over that of the better constant, whose mean is smaller."""
        return self.taken[policy].p99_s / self.taken[self.better].p99_s

    def behind(self, policy: str) -> bool:
        return self.mean_ratio(policy) > MEAN_BEHIND or self.p99_ratio(policy) > P99_BEHIND


def figures_of(family: str, recording: str, runs: Mapping[str, Sequence[Outcome]]) -> Figures:
    """DataError if a policy answered no task, so that nothing can be compared."""
    for policy, outcomes in runs.items():
        if not any(run.answered for run in outcomes):
            raise DataError(f"{family}/{recording}: {policy} answered no task")
    return Figures(family, recording, {policy: _taken(outcomes) for policy, outcomes in runs.items()})


def _taken(runs: Sequence[Outcome]) -> Taken:
    answered = [one for run in runs for one in run.answered]
    seconds = np.array([one.response_s for one in answered])
    references = [one for run in runs for one in run.references]
    oracle_s = sum(one.oracle_s for one in references)
    return Taken(
        mean_s=float(seconds.mean()),
        p99_s=float(quantile(seconds[None], 99)[0]),
        over_oracle=sum(one.sent_s for one in references) / oracle_s if oracle_s else None,
        cloud_percent=100 * float(np.mean([CLOUD in one.sites for one in answered])),
        tasks=len(answered),
        lost=sum(sum(run.asked.values()) for run in runs) - len(answered),
    )
