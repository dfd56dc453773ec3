"""Plays scenarios with this checkout and another one, in turns, and compares the times of the same tasks.

    python -m benchmarks.against ../before --cases calm,apriltags-10 --seeds 4 --out out/against

Each run is a `loadgen run` in its own checkout. A run that has a summary is not played again, so that the
whole can be stopped and resumed; delete its folder to play it again.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Table
from offboard.loadgen.play.run_files import ANSWERS, SUMMARY, TRACE
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.scenario.scenario_file import find_scenario
from offboard.loadgen.table.confidence_intervals import Blocks, Picks
from offboard.loadgen.table.measured_rows import Column

HERE = Path(__file__).parents[1]
RUN_S_MAX = 1800.0
FROM_TASK = 20  # before it, both sites run most tasks
BEFORE, AGAIN, AFTER = "before", "again", "after"
CONSTANTS = ("onboard", "cloud")
STRATEGIES = {  # what a line of the table shows: a checkout and a policy
    BEFORE: (BEFORE, "default"),
    AGAIN: (BEFORE, "default"),  # how much the figures move by themselves
    AFTER: (AFTER, "default"),
    "paper": (AFTER, "paper"),
    **{site: (AFTER, site) for site in CONSTANTS},
}


@dataclass(frozen=True, slots=True)
class Case:
    """A scenario as it is played: with so many tasks, and with another bandwidth (Mbit/s) or robot CPU."""

    scenario: str
    tasks: int
    bandwidth_mbps: float | None = None
    robot_cpus: float | None = None

    def text(self) -> str:
        """The scenario file."""
        path = find_scenario(self.scenario)
        text = re.sub(
            r'(?m)^map = "(.*)"$',
            lambda found: f'map = "{(path.parent / found[1]).resolve()}"',
            path.read_text(),
        )
        if self.bandwidth_mbps is not None:
            text = re.sub(r"(?m)^bandwidth_mbps = .*$", f"bandwidth_mbps = {self.bandwidth_mbps:g}", text)
        if self.robot_cpus is not None:
            text = re.sub(r"(?m)^cpus = .*$", f"cpus = {self.robot_cpus:g}", text, count=1)
        return text


PLANS = ("calm", "outage", "robot-busy", "throttled", "heavy-tail")
CASES: dict[str, Case] = {
    **{name: Case(name, 150) for name in PLANS},
    **{
        f"{name}-{mbps}": Case(f"{name}-calm", 60, bandwidth_mbps=mbps)
        for name in ("apriltags", "registration", "signs")
        for mbps in (400, 50, 10)
    },
    **{
        f"{name}-{mbps}-one-cpu": Case(f"{name}-calm", 60, bandwidth_mbps=mbps, robot_cpus=1)
        for name in ("apriltags", "registration")
        for mbps in (50, 10)
    },
    **{
        f"{name}-{event}": Case(f"{name}-{event}", 60)
        for name in ("apriltags", "registration")
        for event in ("outage", "bandwidth", "busy")
    },
}


@dataclass(frozen=True, slots=True)
class Played:
    """What the files of a run say: the time of each task, and predicted and true seconds by site."""

    times_s: Mapping[int, float]
    predicted_s: Mapping[str, Sequence[tuple[float, float]]]
    to_cloud: float


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description=__doc__)
    parser.add_argument("before", type=Path, metavar="CHECKOUT", help="the other checkout")
    parser.add_argument("--cases", default=",".join(CASES), help="some of %(default)s")
    parser.add_argument("--strategies", default=",".join(STRATEGIES), help="some of %(default)s")
    parser.add_argument("--tasks", type=int, help="tasks of each run (default: 150 of plans, 60 of others)")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each (default: %(default)s)")
    parser.add_argument("--first-seed", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/against"), help="(default: %(default)s)")
    flags = parser.parse_args()
    cases, strategies = flags.cases.split(","), flags.strategies.split(",")
    for name, known in [*((one, CASES) for one in cases), *((one, STRATEGIES) for one in strategies)]:
        if name not in known:
            parser.error(f"{name!r} is not one of {', '.join(known)}")
    checkouts = {BEFORE: flags.before.resolve(), AFTER: HERE}
    if not (checkouts[BEFORE] / "loadgen").is_dir():
        parser.error(f"{flags.before} is no checkout of Offboard")
    seeds = range(flags.first_seed, flags.first_seed + flags.seeds)
    found = {}
    for name in cases:
        file = flags.out.resolve() / name / f"{name}.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(CASES[name].text())
        runs: dict[str, list[Played]] = {strategy: [] for strategy in strategies}
        for n, seed in enumerate(seeds):
            turn = n % len(strategies)
            for strategy in [*strategies[turn:], *strategies[:turn]]:
                checkout, policy = STRATEGIES[strategy]
                out = file.parent / f"{seed}-{strategy}"
                play(
                    checkouts[checkout],
                    file,
                    out,
                    policy=policy,
                    seed=seed,
                    tasks=flags.tasks or CASES[name].tasks,
                )
                runs[strategy].append(read(out))
        found[name] = runs
        print(table(name, runs), flush=True)
    if {BEFORE, AFTER} <= set(strategies):
        print(pooled(found))
    return 0


def play(
    checkout: Path,
    file: Path,
    out: Path,
    *,
    policy: str,
    seed: int,
    tasks: int,
    predictor: str | None = None,
) -> None:
    """Play one run, unless it was played before."""
    if (out / SUMMARY).is_file():
        return
    print(f"{file.stem}: {out.name}", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "offboard.loadgen", "run", str(file), "--policy", policy]
    command += ["--seed", str(seed), "--tasks", str(tasks), "--out", str(out)]
    command += [] if predictor is None else ["--predictor", predictor]
    done = subprocess.run(
        command,
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
        timeout=RUN_S_MAX,
        check=False,
    )
    if not (out / SUMMARY).is_file():  # a check that fails is no failure here
        sys.exit(f"{' '.join(command)} in {checkout} failed:\n{done.stderr}")


def read(out: Path) -> Played:
    """The files of a run. The trace is read as plain JSON: another checkout may have another format."""
    times = {line["i"]: line["ended_s"] - line["due_s"] for line in read_lines(out / ANSWERS)}
    predicted: dict[str, list[tuple[float, float]]] = {site: [] for site in CONSTANTS}
    chosen = []
    for record in read_lines(out / TRACE):
        if not record["decision"]["both"]:
            chosen.append(record["decision"]["site"] == "cloud")
        if record["i"] < FROM_TASK:
            continue
        for one in record["executions"]:
            expected = record["sites"].get(one["site"], {}).get("predicted_s")
            if one["ok"] and expected is not None:
                predicted[one["site"]].append((expected, one["seconds"]))
    return Played(times, predicted, 100 * float(np.mean(chosen)) if chosen else 0.0)


def table(name: str, runs: Mapping[str, Sequence[Played]], base: str = BEFORE) -> Table:
    """The figures of one case; ratios are those of the sums over the tasks of all seeds."""
    before = together(runs[base]) if base in runs else None
    constants = [together(runs[site]).mean() for site in CONSTANTS if site in runs]
    rows = []
    for strategy, played in runs.items():
        times_s = together(played)
        rows.append(
            [
                strategy,
                f"{1e3 * times_s.mean():.1f}",
                f"{1e3 * np.percentile(times_s, 95):.1f}",
                "-" if before is None else ratio(times_s, before),
                f"{times_s.mean() / min(constants):.3f}" if constants else "-",
                f"{np.mean([one.to_cloud for one in played]):.0f}",
                *(bias(played, site) for site in CONSTANTS),
            ]
        )
    columns = ["", "mean ms", "P95 ms", f"/ {base}", "/ better constant", "cloud %"]
    columns += [f"predicted / true {site}" for site in CONSTANTS]
    seeds = len(next(iter(runs.values())))
    return Table(f"{name}, {seeds} seeds, from task {FROM_TASK}", columns, rows)


def pooled(found: Mapping[str, Mapping[str, Sequence[Played]]]) -> Table:
    """The ratio over all cases: the geometric mean, so that each case counts the same."""
    logs = []
    for runs in found.values():
        after, before = together(runs[AFTER]), together(runs[BEFORE])
        blocks = Blocks(len(after)).resampled(lambda picks, a=after, b=before: {"r": _log_ratio(a, b, picks)})
        logs.append((_log_ratio(after, before, np.arange(len(after))[None])[0], blocks["r"]))
    mean, spread = np.mean([one for one, _ in logs]), np.mean([each for _, each in logs], axis=0)
    low, high = np.exp(np.percentile(spread, (2.5, 97.5)))
    worst = max((float(np.exp(one)), name) for name, (one, _) in zip(found, logs, strict=True))
    row = [f"{np.exp(mean):.3f}", f"{low:.3f}", f"{high:.3f}", f"{worst[0]:.3f} ({worst[1]})"]
    return Table(f"{AFTER} / {BEFORE}, all cases", ["ratio", "2.5 %", "97.5 %", "worst case"], [row])


def together(runs: Sequence[Played]) -> Column:
    """The times of all seeds, from FROM_TASK on, in the order of the tasks."""
    return np.array([one.times_s[i] for one in runs for i in sorted(one.times_s) if i >= FROM_TASK])


def ratio(times_s: Column, before: Column) -> str:
    if len(times_s) != len(before):
        return "-"
    ends: tuple[Any, ...] = Blocks(len(before)).intervals(
        lambda picks: {"r": times_s[picks].sum(axis=-1) / before[picks].sum(axis=-1)}
    )
    bounds = f" [{ends[0]['r']:.3f}, {ends[1]['r']:.3f}]" if ends[0] else ""
    return f"{times_s.sum() / before.sum():.3f}{bounds}"


def bias(runs: Sequence[Played], site: str) -> str:
    """Sum of the predictions over the sum of the true times, and the number of runs."""
    pairs = np.array([pair for one in runs for pair in one.predicted_s[site]])
    return f"{pairs[:, 0].sum() / pairs[:, 1].sum():.2f} ({len(pairs)})" if len(pairs) else "-"


def _log_ratio(after: Column, before: Column, picks: Picks) -> Column:
    found: Column = np.log(after[picks].sum(axis=-1) / before[picks].sum(axis=-1))
    return found


if __name__ == "__main__":
    sys.exit(main())
