"""`loadgen compare --recordings FOLDER`: plays a scenario over each recording of a folder, with each policy.

`recording_table` computes the figures by family.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.compare.compare_settings import CompareConfig, split_strategy
from offboard.loadgen.compare.recording_figures import Figures, figures_of
from offboard.loadgen.compare.recording_table import HEADINGS, Comparison, tables
from offboard.loadgen.compare.resume import play_once
from offboard.loadgen.progress import Progress, progress
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.robot.workload import CONSTANT
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool

RECORDINGS_MAX = 10_000
AT_ONCE = 64  # scenarios that are simulated before their outcomes are reduced to figures
TASKS = 300  # unless --tasks says another number
CSV, UP, DOWN = ".csv", ".up", ".down"


@dataclass(frozen=True, slots=True)
class RecordedLink:
    """A recording of a folder: its family, its name and its `files`, by their names in `[link]`."""

    family: str
    name: str
    files: Mapping[str, Path]


def run_recordings(names: Sequence[str], folder: Path, config: CompareConfig) -> int:
    """Play all scenarios over all recordings, then print the tables to stdout."""
    config.check_columns(HEADINGS, config.format)
    links = find_recordings(folder)
    scenarios = []
    for path in map(find_scenario, names):
        scenario = read_scenario(path).changed(
            tasks=config.tasks or TASKS, reference=config.reference, heartbeats=config.heartbeats
        )
        check_calls(scenario, path)
        scenario = at_rate(scenario, config.rate)
        for link in links:
            check_events(over(scenario, link, scenario.seed))
        if config.simulate:
            check_simulated(over(scenario, links[0], scenario.seed))
        scenarios.append(scenario)
    played = _simulated if config.simulate else _played
    compared = [
        Comparison(
            scenario=scenario.name,
            tasks=scenario.workload.tasks,
            arrivals=_arrivals(scenario),
            figures=played(scenario, links, config),
            taken_from_link={link.family: from_link(over(scenario, link, scenario.seed)) for link in links},
        )
        for scenario in scenarios
    ]
    sys.stdout.write(tables(compared, config))
    return 0


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


def _arrivals(scenario: Scenario) -> str:
    workload = scenario.workload
    return "one at a time" if workload.rate is None else f"{workload.rate:g} a second"


def _units(
    scenario: Scenario, links: Sequence[RecordedLink], config: CompareConfig
) -> Iterator[tuple[RecordedLink, Scenario]]:
    for link in links:
        for n in range(config.seeds):
            yield link, over(scenario, link, scenario.seed + n)


def _simulated(scenario: Scenario, links: Sequence[RecordedLink], config: CompareConfig) -> list[Figures]:
    strategies = {name: _strategy(name) for name in config.policies}
    figures: list[Figures] = []
    step = max(1, AT_ONCE // config.seeds)
    with SimulationPool(config.jobs) as pool:
        for first in range(0, len(links), step):
            links_now = links[first : first + step]
            units = list(_units(scenario, links_now, config))
            played = pool.play([one for _, one in units], strategies)
            for link in links_now:
                places = [n for n, (of, _) in enumerate(units) if of is link]
                runs = {name: [outcomes[n] for n in places] for name, outcomes in played.items()}
                figures.append(_reduced(link, scenario, runs, config))
    return figures


def _played(scenario: Scenario, links: Sequence[RecordedLink], config: CompareConfig) -> list[Figures]:
    with progress("runs", len(links) * config.seeds * len(config.policies)) as shown:
        return [_play(scenario, link, config, shown, turn=n) for n, link in enumerate(links)]


def _play(
    scenario: Scenario, link: RecordedLink, config: CompareConfig, shown: Progress, *, turn: int
) -> Figures:
    """Real runs over one recording; over all recordings each policy comes first equally often."""
    runs: dict[str, list[Outcome]] = {policy: [] for policy in config.policies}
    for n, (_, unit) in enumerate(_units(scenario, [link], config), turn):
        first = n % len(config.policies)
        for policy in (*config.policies[first:], *config.policies[:first]):
            out = config.out / unit.name / f"{unit.seed}-{policy}"
            print(f"{unit.name}, seed {unit.seed}, policy {policy}", file=sys.stderr, flush=True)
            played = play_once(unit.changed(**_strategy(policy)), out, config.testbed, config.stolen_max)
            runs[policy].append(played.outcome)
            shown.step()
    return _reduced(link, scenario, runs, config)


def _reduced(
    link: RecordedLink, scenario: Scenario, runs: Mapping[str, Sequence[Outcome]], config: CompareConfig
) -> Figures:
    compared = scenario.compared()
    kept = {name: [run.of(compared).between(config.from_task) for run in of] for name, of in runs.items()}
    return figures_of(link.family, link.name, kept)


def _strategy(name: str) -> dict[str, Any]:
    return dict(zip(("policy", "predictor"), split_strategy(name), strict=True))
