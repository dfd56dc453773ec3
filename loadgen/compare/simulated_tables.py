"""`loadgen compare --simulate`: simulates all runs and gives one table for each scenario.

With several scenarios, a summary table over all of them comes first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from typing import Any

from offboard.loadgen.compare.compare_settings import CompareConfig, split_strategy
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.table.table_formats import Heading, Table

ABOUT = "time over oracle of each policy"
DIGITS = 3


def simulated(scenarios: Sequence[Scenario], config: CompareConfig) -> str:
    """All tables, as text in the chosen format."""
    for scenario in scenarios:
        check_simulated(scenario)
    with SimulationPool(config.jobs) as pool:
        tables = [_table(scenario, config, pool) for scenario in scenarios]
    if len(tables) == 1:
        return config.text(tables, config.format)
    summary = summary_table(_over_oracle(scenarios, tables, config.policies), _caption(config))
    if config.format == "csv":  # the summary has other columns
        return config.text([summary], config.format) + "\n" + config.text(tables, config.format)
    return config.text([summary, *tables], config.format)


def summary_table(figures: Mapping[str, Mapping[str, float | None]], caption: str) -> Table:
    """One line for each policy. `figures` holds time over oracle by policy, then by scenario.

    `mean` and `worst` are taken over the scenarios where the figure is defined.
    """
    scenarios = list(next(iter(figures.values())))
    columns = {name: f"on_{name.replace('-', '_')}" for name in scenarios}
    fields = [("policy", str), *((name, float | None) for name in ("mean", "worst", *columns.values()))]
    line = make_dataclass("SummaryLine", [*fields, ("note", str, "")], frozen=True)
    headings = {
        "policy": Heading("policy", "policy", None),
        "mean": Heading("mean", "mean", DIGITS),
        "worst": Heading("worst", "worst", DIGITS),
        **{column: Heading(name, name, DIGITS) for name, column in columns.items()},
    }
    lines = [
        line(policy, *_mean_and_worst(list(of.values())), *of.values()) for policy, of in figures.items()
    ]
    return Table(caption, {"summary": ABOUT}, headings, lines)


def _mean_and_worst(values: Sequence[float | None]) -> tuple[Any, Any]:
    there = [value for value in values if value is not None]
    return (sum(there) / len(there), max(there)) if there else (None, None)


def _table(scenario: Scenario, config: CompareConfig, pool: SimulationPool) -> Table:
    strategies = {
        name: dict(zip(("policy", "predictor"), split_strategy(name), strict=True))
        for name in config.policies
    }
    seeds = [scenario.changed(seed=scenario.seed + n) for n in range(config.seeds)]
    played = pool.play(seeds, strategies)
    compared = scenario.compared()
    runs = {name: [run.of(compared).between(config.from_task) for run in played[name]] for name in played}
    return comparison_table(scenario, config, runs, pool.map)


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
    seeds = "1 seed" if config.seeds == 1 else f"{config.seeds} seeds"
    return (
        f"Time / oracle in simulation, {seeds}: time of all tasks{span}, divided by the time that the faster"
        " site takes for each of them. Mean and worst are over the scenarios."
    )
