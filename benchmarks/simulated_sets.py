"""Sets of scenarios, simulated with the code of a checkout: time over oracle of each scenario and seed.

A scenario that was simulated with the same seeds and strategies is not simulated again; delete its file to do
so. What the figures are compared with is in `against_simulated` and `ablations`.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.against import FROM_TASK, HERE
from benchmarks.measure import Table
from offboard.common.errors import ConfigError
from offboard.loadgen.robot.workload import CLOSED
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped
from offboard.loadgen.simulation.simulated_testbed import check_simulated
from offboard.loadgen.table.confidence_intervals import Blocks

UNSEEN = HERE / "benchmarks" / "unseen"
FRESH_SEED = 1001
SETS = SHIPPED, FRESH, NEW = "shipped", "fresh", "unseen"

Figures = Mapping[tuple[str, int], float]  # time over oracle, by scenario and seed


@dataclass(frozen=True, slots=True)
class ScenarioSet:
    """Scenarios, and the seeds that each of them is simulated with; None: from its own seed on."""

    scenarios: Sequence[Path]
    seeds: int
    first_seed: int | None = None


@dataclass(frozen=True, slots=True)
class Checkout:
    """The code at this path, which runs in processes of its own."""

    path: Path

    @property
    def module(self) -> str:
        """`loadgen`, as it is imported there: older checkouts have no package `offboard`."""
        return "offboard.loadgen" if (self.path / "offboard").is_dir() else "loadgen"

    def is_one(self) -> bool:
        return (self.path / "loadgen" / "scenarios").is_dir()

    def text(self, scenario: Path, name: str, seed: int) -> str:
        """A scenario file of ours with another name and seed, for this checkout."""
        text = scenario.read_text()
        own = self.path / "loadgen" / "scenarios" / scenario.name
        if task := re.search(r"(?m)^task = .*$", own.read_text() if own.is_file() else ""):
            text = re.sub(r"(?m)^task = .*$", task[0], text)  # its modules may have other names
        text = re.sub(r"(?m)^name = .*$", f'name = "{name}"', text, count=1)
        text = re.sub(r"(?m)^seed = .*$", f"seed = {seed}", text, count=1)
        return re.sub(
            r'(?m)^map = "(.*)"$',
            lambda found: f'map = "{(scenario.parent / found[1]).resolve()}"',
            text,
        )


def scenario_sets(names: Sequence[str] | None = None) -> dict[str, ScenarioSet]:
    """All sets by name, with some of the scenarios or (None) all of them."""

    def some(paths: Sequence[Path]) -> list[Path]:
        return [path for path in paths if names is None or path.stem in names]

    simulated = some(list(_simulated()))
    return {
        SHIPPED: ScenarioSet(simulated, 6),
        FRESH: ScenarioSet(simulated, 12, FRESH_SEED),
        NEW: ScenarioSet(some(sorted(UNSEEN.glob("*.toml"))), 6),
    }


def simulate(
    checkout: Checkout,
    scenarios: ScenarioSet,
    strategies: Sequence[str],
    out: Path,
    *,
    flags: Sequence[str] = (),
) -> dict[str, Figures]:
    """Simulate a whole set; the figures of each strategy. `flags` are further ones of `loadgen compare`."""
    found: dict[str, dict[tuple[str, int], float]] = {strategy: {} for strategy in strategies}
    for path in scenarios.scenarios:
        first = read_scenario(path).seed if scenarios.first_seed is None else scenarios.first_seed
        seeds = range(first, first + scenarios.seeds)
        for strategy, seed, figure in _simulate(checkout, path, seeds, strategies, out, flags):
            found[strategy][path.stem, seed] = figure
    return found


def compare(checkout: Checkout, names: Sequence[str], flags: Sequence[str]) -> dict[str, Any]:
    """What `loadgen compare --simulate` of a checkout says of these scenarios, as JSON."""
    command = [sys.executable, "-m", checkout.module, "compare", *names]
    command += ["--simulate", "--format", "json", *flags]
    environ = {**os.environ, "PYTHONPATH": str(checkout.path)}
    done = subprocess.run(
        command, cwd=checkout.path, env=environ, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{' '.join(command)} in {checkout.path} failed:\n{done.stderr}")
    said: dict[str, Any] = json.loads(done.stdout)
    return said


def table(title: str, figures: Mapping[str, Figures], base: str) -> Table:
    """A line for each strategy, compared with the strategy `base` on the same scenarios and seeds."""
    columns = ["", "mean time / oracle", "worst scenario", f"minus {base}", "largest difference"]
    rows = []
    for name, of in figures.items():
        means = by_scenario(of)
        worst = max(means, key=means.__getitem__)
        row = [name, f"{mean(of):.3f}", f"{means[worst]:.3f} ({worst})"]
        rows.append([*row, *(("", "") if name == base else differences(of, figures[base]))])
    scenarios, pairs = len(by_scenario(figures[base])), len(figures[base])
    return Table(f"{title}: {scenarios} scenarios, {pairs // scenarios} seeds", columns, rows)


def differences(of: Figures, base: Figures) -> tuple[str, str]:
    """The mean difference with its 95 % interval, and that of the scenario where it is largest."""
    pairs = np.array([of[pair] - base[pair] for pair in base])
    ends = Blocks(len(pairs), length=1).intervals(lambda picks: {"mean": pairs[picks].mean(axis=-1)})
    bounds = f" [{ends[0]['mean']:+.4f}, {ends[1]['mean']:+.4f}]" if ends[0] else ""
    each = by_scenario({pair: of[pair] - base[pair] for pair in base})
    far = max(each, key=lambda name: abs(each[name]))
    return f"{pairs.mean():+.4f}{bounds}", f"{each[far]:+.3f} ({far})"


def by_scenario(figures: Figures) -> dict[str, float]:
    """The mean over the seeds of each scenario."""
    names = dict.fromkeys(name for name, _ in figures)
    return {name: float(np.mean([figures[pair] for pair in figures if pair[0] == name])) for name in names}


def mean(figures: Figures) -> float:
    """The mean over all scenarios and seeds."""
    return float(np.mean(list(figures.values())))


def _simulated() -> Iterator[Path]:
    """The shipped scenarios with checks that can be simulated and whose tasks come one after the other."""
    for name in shipped():
        scenario = read_scenario(path := find_scenario(name))
        if scenario.workload.arrivals != CLOSED or not scenario.checks:
            continue
        try:
            check_simulated(scenario)
        except ConfigError:
            continue
        yield path


def _simulate(
    checkout: Checkout,
    scenario: Path,
    seeds: Sequence[int],
    strategies: Sequence[str],
    out: Path,
    flags: Sequence[str],
) -> list[tuple[str, int, float]]:
    """Strategy, seed and figure of each run of one scenario, which may be known already."""
    kept, asked = out / f"{scenario.stem}.json", {"seeds": list(seeds), "strategies": list(strategies)}
    if kept.is_file() and (known := json.loads(kept.read_text()))["asked"] == asked:
        return [tuple(run) for run in known["runs"]]
    print(f"{out.parent.name}, {out.name}: {scenario.stem}", file=sys.stderr, flush=True)
    folder = out / scenario.stem
    folder.mkdir(parents=True, exist_ok=True)
    files = {f"{scenario.stem}-{seed}": seed for seed in seeds}
    for name, seed in files.items():
        (folder / f"{name}.toml").write_text(checkout.text(scenario, name, seed))
    asked_too = ["--seeds", "1", "--from-task", str(FROM_TASK), "--policies", ",".join(strategies), *flags]
    said = compare(checkout, [f"{folder / name}.toml" for name in files], asked_too)
    runs = [
        (line["policy"], files[one["scenario"]], line["time_over_oracle"])
        for one in said["tables"]
        if "scenario" in one  # the first table is a summary
        for line in one["scores"]
        if not line["bound"]
    ]
    kept.write_text(json.dumps({"asked": asked, "runs": runs}))
    return runs
