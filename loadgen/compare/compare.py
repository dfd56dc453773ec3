"""`loadgen compare`: plays the same seeded scenario once with each policy and compares the results.

With --simulate the runs are simulated; with --recordings each scenario is played over every recording of a
folder. `comparison_table` computes the figures, and `recording_table` those over recordings.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from offboard.common.config import REQUIRED
from offboard.common.errors import ConfigError
from offboard.loadgen.compare import recording_table
from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.comparison_line import HEADINGS
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.compare.recordings import (
    Figures,
    RecordedLink,
    at_rate,
    check_events,
    figures_of,
    find_recordings,
    from_link,
    over,
)
from offboard.loadgen.compare.runs import outcomes, play_runs, read_scenarios
from offboard.loadgen.play.machine import NOTED_PERCENT
from offboard.loadgen.progress import Progress, progress
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.table.table_formats import Table, column, headings_of

SUMMARY = "time over oracle of each policy"
SUMMARY_DIGITS = 3
AT_ONCE = 64  # scenarios over recordings that are simulated before their outcomes are reduced to figures
RECORDED_TASKS = 300  # over a recording, unless --tasks says another number


def run_compare(names: Sequence[str], config: CompareConfig) -> int:
    """Play all scenarios, then print one table for each to stdout. Progress lines go to stderr."""
    if config.recordings is not None:
        return _run_recordings(names, config.recordings, config)
    config.check_columns(HEADINGS)
    scenarios = read_scenarios(
        names, tasks=config.tasks, reference=config.reference, heartbeats=config.heartbeats
    )
    _refuse_streams(scenarios)
    for scenario in scenarios:
        if config.from_task >= scenario.workload.tasks:
            wrong = f"--from-task: {config.from_task} is not among the {scenario.workload.tasks} tasks"
            raise ConfigError(f"{wrong} of {scenario.name}")
    if config.simulate:
        sys.stdout.write(simulated(scenarios, config))
    else:
        with progress("runs", len(scenarios) * config.seeds * len(config.policies)) as shown:
            tables = [compare(scenario, config, shown) for scenario in scenarios]
        sys.stdout.write(config.text(tables))
    return 0


def compare(scenario: Scenario, config: CompareConfig, shown: Progress) -> Table:
    """Play the scenario once for each seed and policy; the table of all policies. Each run is a step."""
    played = play_runs(config.seeded(scenario), config, shown, stolen_max=config.stolen_max)
    runs = config.counted(scenario, outcomes(played))
    stolen = {
        f"{one.scenario.seed}-{policy}": one.stolen_percent
        for policy, of in played.items()
        for one in of
        if one.stolen_percent is not None
    }
    return replace(comparison_table(scenario, config, runs), notes=_stolen_notes(stolen))


def simulated(scenarios: Sequence[Scenario], config: CompareConfig) -> str:
    """Simulate all runs; all tables as text. With several scenarios, a table over all of them comes first."""
    for scenario in scenarios:
        check_simulated(scenario)
    with SimulationPool(config.jobs) as pool:
        tables = [_simulated_table(scenario, config, pool) for scenario in scenarios]
    if len(tables) == 1:
        return config.text(tables)
    summary = summary_table(_over_oracle(scenarios, tables, config.policies), _caption(config))
    if config.format == "csv":  # the summary has other columns
        return config.text([summary]) + "\n" + config.text(tables)
    return config.text([summary, *tables])


def summary_table(figures: Mapping[str, Mapping[str, float | None]], caption: str) -> Table:
    """One line for each policy. `figures` holds time over oracle by policy, then by scenario.

    `mean` and `worst` are taken over the scenarios where the figure is defined.
    """
    scenarios = {f"on_{name.replace('-', '_')}": name for name in next(iter(figures.values()))}
    headings = {"mean": "mean", "worst": "worst"} | scenarios
    cells = [
        ("policy", str, column("policy", default=REQUIRED)),
        *((name, float | None, column(heading, SUMMARY_DIGITS)) for name, heading in headings.items()),
        ("note", str, ""),
    ]
    line = make_dataclass("SummaryLine", cells, frozen=True)
    lines = [
        line(policy, *_mean_and_worst(list(of.values())), *of.values()) for policy, of in figures.items()
    ]
    return Table(caption, {"summary": SUMMARY}, headings_of(line), lines)


def _mean_and_worst(values: Sequence[float | None]) -> tuple[Any, Any]:
    there = [value for value in values if value is not None]
    return (sum(there) / len(there), max(there)) if there else (None, None)


def _simulated_table(scenario: Scenario, config: CompareConfig, pool: SimulationPool) -> Table:
    played = pool.play(config.seeded(scenario), config.strategies())
    return comparison_table(scenario, config, config.counted(scenario, played), pool.map)


def _over_oracle(
    scenarios: Sequence[Scenario], tables: Sequence[Table], policies: Sequence[str]
) -> dict[str, dict[str, float | None]]:
    """Time over oracle by policy, then by scenario."""
    found: dict[str, dict[str, float | None]] = {policy: {} for policy in policies}
    for scenario, one in zip(scenarios, tables, strict=True):
        for line in one.lines:
            if not line.bound:
                found[line.policy][scenario.name] = line.time_over_oracle
    return found


def _caption(config: CompareConfig) -> str:
    span = f" from task {config.from_task} on" if config.from_task else ""
    return (
        f"Time / oracle in simulation, {config.count_of_seeds}: time of all tasks{span}, divided by the time"
        " that the faster site takes for each of them. Mean and worst are over the scenarios."
    )


def _stolen_notes(stolen: Mapping[str, float]) -> tuple[str, ...]:
    """A note about the CPU time that the host took from the runs (percent by run), if it was too much."""
    worst = max(stolen, key=stolen.__getitem__, default=None)
    if worst is None or stolen[worst] < NOTED_PERCENT:
        return ()
    return (
        f"The host of this virtual machine took {median(stolen.values()):.0f} % of the CPU time in the median"
        f" run, and {stolen[worst]:.0f} % in {worst}. This changes the times of the tasks; see --stolen-max.",
    )


def _refuse_streams(scenarios: Sequence[Scenario]) -> None:
    """ConfigError for a stream: its steps have no site and no time that could be compared."""
    for one in scenarios:
        if one.workload.streams:
            instead = f"loadgen checks {one.name} --policies stream,half-empty"
            raise ConfigError(f"{one.name} is a stream; compare its rules by {instead}")


def _run_recordings(names: Sequence[str], folder: Path, config: CompareConfig) -> int:
    """Play all scenarios over all recordings, then print the tables to stdout."""
    config.check_columns(recording_table.HEADINGS)
    links = find_recordings(folder)
    read = read_scenarios(
        names, tasks=config.tasks or RECORDED_TASKS, reference=config.reference, heartbeats=config.heartbeats
    )
    _refuse_streams(read)
    scenarios = [at_rate(scenario, config.rate) for scenario in read]
    for scenario in scenarios:
        for link in links:
            check_events(over(scenario, link, scenario.seed))
        if config.simulate:
            check_simulated(over(scenario, links[0], scenario.seed))
    played = _simulate_links if config.simulate else _play_links
    compared = [
        recording_table.Comparison(
            scenario=scenario.name,
            tasks=scenario.workload.tasks,
            arrivals=_arrivals(scenario),
            figures=played(scenario, links, config),
            taken_from_link={link.family: from_link(over(scenario, link, scenario.seed)) for link in links},
        )
        for scenario in scenarios
    ]
    sys.stdout.write(recording_table.tables(compared, config))
    return 0


def _arrivals(scenario: Scenario) -> str:
    workload = scenario.workload
    return "one at a time" if workload.rate is None else f"{workload.rate:g} a second"


def _units(scenario: Scenario, link: RecordedLink, config: CompareConfig) -> list[Scenario]:
    return [over(scenario, link, scenario.seed + n) for n in range(config.seeds)]


def _simulate_links(
    scenario: Scenario, links: Sequence[RecordedLink], config: CompareConfig
) -> list[Figures]:
    figures: list[Figures] = []
    seeds, step = config.seeds, max(1, AT_ONCE // config.seeds)
    with SimulationPool(config.jobs) as pool:
        for first in range(0, len(links), step):
            links_now = links[first : first + step]
            units = [unit for link in links_now for unit in _units(scenario, link, config)]
            played = pool.play(units, config.strategies())
            for at, link in enumerate(links_now):
                runs = {name: of[at * seeds : (at + 1) * seeds] for name, of in played.items()}
                figures.append(figures_of(link.family, link.name, config.counted(scenario, runs)))
    return figures


def _play_links(scenario: Scenario, links: Sequence[RecordedLink], config: CompareConfig) -> list[Figures]:
    """Real runs; over all recordings each policy comes first equally often."""
    figures = []
    with progress("runs", len(links) * config.seeds * len(config.policies)) as shown:
        for turn, link in enumerate(links):
            units = _units(scenario, link, config)
            played = play_runs(units, config, shown, first_turn=turn, stolen_max=config.stolen_max)
            runs = config.counted(scenario, outcomes(played))
            figures.append(figures_of(link.family, link.name, runs))
    return figures
