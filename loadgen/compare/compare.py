"""`loadgen compare`: plays the same seeded scenario once with each policy and compares the results.

The runs of one seed follow each other directly, and each policy comes first equally often, so that changes
of the machine affect all policies in the same way. `comparison_table` computes the figures.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import median

from offboard.common.errors import ConfigError
from offboard.loadgen.compare.compare_settings import CompareConfig, split_strategy
from offboard.loadgen.compare.comparison_table import HEADINGS, comparison_table
from offboard.loadgen.compare.resume import play_once
from offboard.loadgen.compare.simulated_tables import simulated
from offboard.loadgen.play.stolen_cpu_time import NOTED_PERCENT
from offboard.loadgen.progress import Progress, progress
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario
from offboard.loadgen.table.table_formats import Table


def run_compare(names: Sequence[str], config: CompareConfig) -> int:
    """Play all scenarios, then print one table for each to stdout. Progress lines go to stderr."""
    if config.recordings is not None:
        from offboard.loadgen.compare.recordings import run_recordings

        return run_recordings(names, config.recordings, config)
    config.check_columns(HEADINGS, config.format)
    paths = [find_scenario(name) for name in names]
    scenarios = [
        read_scenario(path).changed(
            tasks=config.tasks, reference=config.reference, heartbeats=config.heartbeats
        )
        for path in paths
    ]
    for scenario, path in zip(scenarios, paths, strict=True):
        check_calls(scenario, path)
        if config.from_task >= scenario.workload.tasks:
            wrong = f"--from-task: {config.from_task} is not among the {scenario.workload.tasks} tasks"
            raise ConfigError(f"{wrong} of {scenario.name}")
    if config.simulate:
        sys.stdout.write(simulated(scenarios, config))
    else:
        with progress("runs", len(scenarios) * config.seeds * len(config.policies)) as shown:
            tables = [compare(scenario, config, shown) for scenario in scenarios]
        sys.stdout.write(config.text(tables, config.format))
    return 0


def compare(scenario: Scenario, config: CompareConfig, shown: Progress) -> Table:
    """Play the scenario once for each seed and policy; the table of all policies. Each run is a step."""
    runs: dict[str, list[Outcome]] = {policy: [] for policy in config.policies}
    stolen: dict[str, float] = {}
    for n in range(config.seeds):
        seed = scenario.seed + n
        for policy in rotated(config.policies, n):
            out = config.out / scenario.name / f"{seed}-{policy}"
            print(f"{scenario.name}, seed {seed}, policy {policy}", file=sys.stderr, flush=True)
            chosen, predictor = split_strategy(policy)
            changed = scenario.changed(seed=seed, policy=chosen, predictor=predictor)
            played = play_once(changed, out, config.testbed, config.stolen_max)
            runs[policy].append(played.outcome.of(scenario.compared()).between(config.from_task))
            shown.step()
            if played.stolen_percent is not None:
                stolen[out.name] = played.stolen_percent
    return replace(comparison_table(scenario, config, runs), notes=_stolen_notes(stolen))


def rotated(names: Sequence[str], turns: int) -> Sequence[str]:
    """The names in the same order, beginning with another one each turn."""
    start = turns % len(names)
    return [*names[start:], *names[:start]]


def _stolen_notes(stolen: Mapping[str, float]) -> tuple[str, ...]:
    """A note about the CPU time that the host took from the runs (percent by run), if it was too much."""
    worst = max(stolen, key=stolen.__getitem__, default=None)
    if worst is None or stolen[worst] < NOTED_PERCENT:
        return ()
    return (
        f"The host of this virtual machine took {median(stolen.values()):.0f} % of the CPU time in the median"
        f" run, and {stolen[worst]:.0f} % in {worst}. This changes the times of the tasks; see --stolen-max.",
    )
