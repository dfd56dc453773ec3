"""`loadgen checks`: plays scenarios with several policies and seeds, and prints the verdict of each check.

`loadgen run` judges one run; this shows how near to its limit a check is, and how much it varies.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen import rivals
from offboard.loadgen.compare.compare import rotated
from offboard.loadgen.compare.compare_settings import JOBS_MAX, SEEDS_MAX, SIMULATION, split_strategy
from offboard.loadgen.compare.resume import play_once
from offboard.loadgen.play.play_scenario import TESTBEDS
from offboard.loadgen.progress import progress
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.pass_fail_check import Check, Verdict
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.table.table_formats import FORMATS, UNDEFINED, Heading, Table, render
from offboard.robot_client import policies


@dataclass(frozen=True)
class ChecksConfig:
    """What is played, and where."""

    policies: tuple[str, ...] = setting(
        (policies.ALIAS,),
        f"policies to judge: {rivals.POLICY_HELP}; POLICY@PREDICTOR uses another predictor than its own",
        metavar="NAME,NAME,..",
    )
    seeds: int = setting(
        3,
        "number of runs of each policy; the seeds count up from the scenario's seed",
        minimum=1,
        maximum=SEEDS_MAX,
    )
    testbed: str = setting(
        "local", "where to play: in local processes or in Docker containers", choices=tuple(TESTBEDS)
    )
    simulate: bool = setting(False, "simulate the runs, and leave out the checks that need real processes")
    jobs: int | None = setting(
        None, "with --simulate: number of processes (default: one for each CPU)", minimum=1, maximum=JOBS_MAX
    )
    out: Path = setting(
        Path("out/checks"),
        "folder for the runs, SCENARIO/SEED-POLICY; a finished run of the same software and settings is"
        " not played again",
        metavar="DIR",
    )
    format: str = setting("md", "output format", choices=FORMATS)

    def __post_init__(self) -> None:
        check(self)
        for policy in self.policies:
            split_strategy(policy)
        if len(set(self.policies)) < len(self.policies):
            raise ConfigError(f"--policies: {','.join(self.policies)}: a policy is named twice")
        if self.jobs is not None and not self.simulate:
            raise ConfigError(f"--jobs: {self.jobs} needs --simulate: real runs are played one by one")
        if self.simulate and self.testbed != "local":
            raise ConfigError(f"--testbed: {self.testbed} cannot be combined with --simulate")


def run_checks(names: Sequence[str], config: ChecksConfig) -> int:
    """Play all scenarios, then print one table for each. A check that fails is a result, not an error."""
    paths = [find_scenario(name) for name in names]
    scenarios = [read_scenario(path) for path in paths]
    for scenario, path in zip(scenarios, paths, strict=True):
        check_calls(scenario, path)
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


def checks_table(scenario: Scenario, config: ChecksConfig, runs: Mapping[str, Sequence[Outcome]]) -> Table:
    """One line for each policy and check: its value in each run, and in how many runs it fails."""
    values = [f"run_{number}" for number in range(1, config.seeds + 1)]
    names = ("policy", "check", *values, "verdict")
    line = make_dataclass("CheckLine", [*((name, str) for name in names), ("note", str, "")], frozen=True)
    headings = {name: Heading(name.replace("_", " "), name.replace("_", " "), None) for name in names}
    lines = []
    for policy, outcomes in runs.items():
        for one in _judged(scenario, config):
            verdicts = [one.judge(outcome) for outcome in outcomes]
            cells = (policy, str(one), *map(_value, verdicts), _verdict(verdicts))
            lines.append(line(**dict(zip(names, cells, strict=True))))
    where = f"in {SIMULATION}" if config.simulate else f"on the {config.testbed} testbed"
    seeds = "seed" if config.seeds == 1 else f"seeds {scenario.seed} to"
    caption = f"Checks of {scenario.name} {where}, {seeds} {scenario.seed + config.seeds - 1}."
    about = {"scenario": scenario.name, "testbed": SIMULATION if config.simulate else config.testbed}
    return Table(caption, about, headings, lines)


def _judged(scenario: Scenario, config: ChecksConfig) -> list[Check]:
    """Without the checks that need real processes, if the runs are simulated."""
    return [one for one in scenario.checks if not (config.simulate and FIGURES[one.figure].real)]


def _value(verdict: Verdict) -> str:
    return UNDEFINED if verdict.value is None else f"{verdict.value:.4g}"


def _verdict(verdicts: Sequence[Verdict]) -> str:
    failed = sum(not verdict.holds for verdict in verdicts)
    if not failed:
        return "holds"
    return "**fails**" if failed == len(verdicts) else f"**fails** in {failed} of {len(verdicts)}"


def _played(scenarios: Sequence[Scenario], config: ChecksConfig) -> list[dict[str, list[Outcome]]]:
    """The outcomes of real runs by policy, for each scenario. Each policy comes first equally often."""
    found = []
    with progress("runs", len(scenarios) * config.seeds * len(config.policies)) as shown:
        for scenario in scenarios:
            runs: dict[str, list[Outcome]] = {policy: [] for policy in config.policies}
            for n in range(config.seeds):
                for policy in rotated(config.policies, n):
                    seed, strategy = scenario.seed + n, _strategy(policy)
                    print(f"{scenario.name}, seed {seed}, policy {policy}", file=sys.stderr, flush=True)
                    out = config.out / scenario.name / f"{seed}-{policy}"
                    played = play_once(scenario.changed(seed=seed, **strategy), out, config.testbed)
                    runs[policy].append(played.outcome)
                    shown.step()
            found.append(runs)
    return found


def _simulated(scenarios: Sequence[Scenario], config: ChecksConfig) -> list[dict[str, list[Outcome]]]:
    strategies = {policy: _strategy(policy) for policy in config.policies}
    with SimulationPool(config.jobs) as pool:
        return [
            pool.play([scenario.changed(seed=scenario.seed + n) for n in range(config.seeds)], strategies)
            for scenario in scenarios
        ]


def _strategy(policy: str) -> dict[str, Any]:
    return dict(zip(("policy", "predictor"), split_strategy(policy), strict=True))
