"""`loadgen checks`: plays scenarios with several policies and seeds, and prints the verdict of each check.

`loadgen run` judges one run; this shows how near to its limit a check is, and how much it varies.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass

from offboard.common.config import REQUIRED
from offboard.common.errors import ConfigError
from offboard.common.wording import rounded
from offboard.loadgen.compare.compare_settings import RunsConfig
from offboard.loadgen.compare.runs import outcomes, play_runs, read_scenarios
from offboard.loadgen.progress import progress
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.pass_fail_check import DIGITS, Check, Verdict
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.table.table_formats import UNDEFINED, Table, column, headings_of, render


def run_checks(names: Sequence[str], config: RunsConfig) -> int:
    """Play all scenarios, then print one table for each. A check that fails is a result, not an error."""
    scenarios = read_scenarios(names)
    for scenario in scenarios:
        if not scenario.checks:
            raise ConfigError(f"{scenario.name} has no checks")
        if config.simulate:
            check_simulated(scenario)
            if not _judged(scenario, config):
                raise ConfigError(f"{scenario.name} has no checks that a simulation can judge")
    played = _simulated(scenarios, config) if config.simulate else _played(scenarios, config)
    tables = [checks_table(scenario, config, runs) for scenario, runs in zip(scenarios, played, strict=True)]
    sys.stdout.write(render(tables, config.format))
    return 0


def checks_table(scenario: Scenario, config: RunsConfig, runs: Mapping[str, Sequence[Outcome]]) -> Table:
    """One line for each policy and check: its value in each run, and in how many runs it fails."""
    values = [f"run_{number}" for number in range(1, config.seeds + 1)]
    names = ("policy", "check", *values, "verdict")
    columns = [(name, str, column(name.replace("_", " "), default=REQUIRED)) for name in names]
    line = make_dataclass("CheckLine", [*columns, ("note", str, "")], frozen=True)
    lines = []
    for policy, played in runs.items():
        for one in _judged(scenario, config):
            verdicts = [one.judge(outcome) for outcome in played]
            cells = (policy, str(one), *map(_value, verdicts), _verdict(verdicts))
            lines.append(line(**dict(zip(names, cells, strict=True))))
    seeds = "seed" if config.seeds == 1 else f"seeds {scenario.seed} to"
    caption = f"Checks of {scenario.name} {config.place}, {seeds} {scenario.seed + config.seeds - 1}."
    about = {"scenario": scenario.name, "testbed": config.where}
    return Table(caption, about, headings_of(line), lines)


def _judged(scenario: Scenario, config: RunsConfig) -> list[Check]:
    """Without the checks that need real processes, if the runs are simulated."""
    return [one for one in scenario.checks if not (config.simulate and FIGURES[one.figure].real)]


def _value(verdict: Verdict) -> str:
    return UNDEFINED if verdict.value is None else rounded(verdict.value, DIGITS)


def _verdict(verdicts: Sequence[Verdict]) -> str:
    failed = sum(not verdict.holds for verdict in verdicts)
    if not failed:
        return "holds"
    return "**fails**" if failed == len(verdicts) else f"**fails** in {failed} of {len(verdicts)}"


def _played(scenarios: Sequence[Scenario], config: RunsConfig) -> list[dict[str, list[Outcome]]]:
    """The outcomes of real runs by policy, for each scenario."""
    with progress("runs", len(scenarios) * config.seeds * len(config.policies)) as shown:
        return [outcomes(play_runs(config.seeded(one), config, shown)) for one in scenarios]


def _simulated(scenarios: Sequence[Scenario], config: RunsConfig) -> list[dict[str, list[Outcome]]]:
    with SimulationPool(config.jobs) as pool:
        return [pool.play(config.seeded(scenario), config.strategies()) for scenario in scenarios]
