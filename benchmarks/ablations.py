"""Leaves out one mechanism of the default at a time, and shows what it costs.

    python -m benchmarks.ablations --recordings .cache/links                     # in simulation
    python -m benchmarks.ablations --cases apriltags-busy,registration-outage    # real runs

A mechanism stays only if leaving it out costs more than 1 % in the mean of a set, or more than 3 % in one
scenario or in one family of recordings, and the 95 % interval of that cost lies above 0. The sets are those
that nothing was tuned on: other seeds of the shipped scenarios, the scenarios of `unseen`, and every second
recording of a folder. Scenarios with an objective of their own are left out: they make something else small.

The classes of `left_out` are the predictors and policies without a mechanism. The cases of real runs are
those of `against`. The command can be stopped and resumed; delete its folder to start anew.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.against import CASES, HERE, Played, play, read
from benchmarks.against import table as table_of_runs
from benchmarks.against_simulated import add_flags, chosen_sets
from benchmarks.measure import Table
from benchmarks.simulated_sets import FRESH, NEW, Checkout, ScenarioSet, compare, simulate
from offboard.loadgen.compare.recordings import find_recordings
from offboard.loadgen.scenario.scenario_file import read_scenario
from offboard.robot_client import policies
from offboard.robot_client.policies.objectives import MEAN

NOTHING = "nothing"
RECORDINGS = "recordings"
WORKLOADS = ("link-plans", "link-frames", "link-images")  # that are played over the recordings
SEEDS = 12
MEAN_COSTS = 0.01  # what a mechanism must be worth in the mean of a set
ONE_COSTS = 0.03  # or in one scenario or family
RATIOS_MIN = 3  # for an interval

Times = Mapping[tuple[str, str], float]  # by scenario and seed, or by family and recording


@dataclass(frozen=True, slots=True)
class LeftOut:
    """The default without a mechanism: a policy, a predictor (None: that of the policy), and heartbeats."""

    policy: str = policies.DEFAULT
    predictor: str | None = None
    heartbeats: bool = True

    @property
    def strategy(self) -> str:
        return self.policy if self.predictor is None else f"{self.policy}@{self.predictor}"


@dataclass(frozen=True, slots=True)
class Cost:
    """What leaving out a mechanism costs, as a share of the time with it.

    `low`, `high`: the 95 % interval over scenarios, seeds or recordings; nan: there are too few of them.
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        bounds = "" if np.isnan(self.low) else f" [{100 * self.low:+.1f}, {100 * self.high:+.1f}]"
        return f"{100 * self.mean:+.1f}{bounds}"


def _predictor(name: str) -> LeftOut:
    return LeftOut(predictor=f"benchmarks.left_out.{name}")


def _policy(name: str) -> LeftOut:
    return LeftOut(f"benchmarks.left_out.{name}")


LEFT_OUT: dict[str, LeftOut] = {
    NOTHING: LeftOut(),
    "hedge": LeftOut("probe:greedy"),
    "time of the hedge: P95": _policy("HedgeAtP95"),
    "probe": LeftOut("hedge:greedy"),
    "heartbeats": LeftOut(heartbeats=False),
    "round trip of heartbeats": _predictor("RoundTrip"),
    "stall": _policy("Stall"),
    "work": _predictor("Work"),
    "all parts: total seconds": _predictor("AllParts"),
    "network apart from run": _predictor("NetworkLine"),
    "bytes": _predictor("Payload"),
    "queue": _predictor("Queue"),
    "capacity": _predictor("Capacity"),
    "load": _predictor("Load"),
    "begin_as": _predictor("LoadedShape"),
    "outlier rules": _predictor("Outliers"),
    "tail": _predictor("Tail"),
    "change": _predictor("Change"),
    "change to slower": _predictor("BadNews"),
    "change to faster at once": _predictor("GoodNews"),
    "change doubles at most": _predictor("Doubling"),
    "bound": _predictor("Bound"),
    "late runs": _predictor("Late"),
    "PACE": _predictor("Pace"),
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablations", description=__doc__)
    parser.add_argument("--left-out", default=",".join(LEFT_OUT), help="some of %(default)s")
    parser.add_argument(
        "--recordings", type=Path, metavar="DIR", help="a folder of recordings to judge by, too"
    )
    parser.add_argument("--cases", help=f"play these instead of simulating: some of {', '.join(CASES)}")
    parser.add_argument("--first-seed", type=int, default=1, help="of the cases (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/ablations"), help="(default: %(default)s)")
    add_flags(parser, sets=(FRESH, NEW))
    flags = parser.parse_args()
    names = list(dict.fromkeys([NOTHING, *flags.left_out.split(",")]))
    cases = flags.cases.split(",") if flags.cases else []
    for name, known in [*((one, LEFT_OUT) for one in names), *((one, CASES) for one in cases)]:
        if name not in known:
            parser.error(f"{name!r} is not one of {', '.join(known)}")
    if cases:
        seeds = range(flags.first_seed, flags.first_seed + (flags.seeds or 1))
        for case in cases:
            print(play_all(case, names, seeds, flags.out.resolve() / case), flush=True)
        return 0
    found = {}
    for name, scenarios in chosen_sets(parser, flags).items():
        judged = replace(
            scenarios,
            scenarios=[path for path in scenarios.scenarios if read_scenario(path).robot.objective == MEAN],
            seeds=flags.seeds or SEEDS,
        )
        found[name] = simulate_all(judged, names, flags.out.resolve() / name)
    if flags.recordings is not None:
        found[RECORDINGS] = over_recordings(flags.recordings, names, flags.out.resolve() / RECORDINGS)
    print(table(found), flush=True)
    return 0


def simulate_all(scenarios: ScenarioSet, names: Sequence[str], out: Path) -> dict[str, Times]:
    """Time over oracle without each mechanism, by scenario and seed."""
    found: dict[str, Times] = {}
    for folder, flags, some in _by_heartbeats(names):
        strategies = [LEFT_OUT[name].strategy for name in some]
        played = simulate(Checkout(HERE), scenarios, strategies, out / folder, flags=flags)
        for name, of in zip(some, played.values(), strict=True):
            found[name] = {(scenario, str(seed)): value for (scenario, seed), value in of.items()}
    return found


def over_recordings(
    folder: Path, names: Sequence[str], out: Path, tasks: int | None = None
) -> dict[str, Times]:
    """The mean time of a task without each mechanism, over every second recording of the folder.

    `tasks`: of each run; None: as many as `loadgen compare --recordings` plays.
    """
    half = out / "half"
    for recorded in find_recordings(folder)[1::2]:
        for path in recorded.files.values():
            link = half / recorded.family / path.name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(path)
    found: dict[str, dict[tuple[str, str], float]] = {name: {} for name in names}
    for sub, flags, some in _by_heartbeats(names):
        by_strategy = {LEFT_OUT[name].strategy: name for name in some}
        for workload in WORKLOADS:
            kept = out / sub / f"{workload}.json"
            strategies = [*by_strategy, "onboard", "cloud"]
            if not kept.is_file() or json.loads(kept.read_text())["strategies"] != strategies:
                print(f"{out.name}: {workload}", file=sys.stderr, flush=True)
                asked = ["--recordings", str(half), "--policies", ",".join(strategies), *flags]
                asked += [] if tasks is None else ["--tasks", str(tasks)]
                said = compare(Checkout(HERE), [workload], asked)
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps({"strategies": strategies, "said": said}))
            for line in recording_lines(json.loads(kept.read_text())["said"]):
                if line["policy"] in by_strategy:
                    key = line["family"], f"{workload}/{line['recording']}"
                    found[by_strategy[line["policy"]]][key] = line["mean_ms"]
    return found


def recording_lines(said: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The lines of single recordings in what `loadgen compare --recordings` printed as JSON."""
    return [line for one in said["tables"] for line in one["scores"] if "recording" in line]


def _by_heartbeats(names: Sequence[str]) -> list[tuple[str, list[str], list[str]]]:
    """A folder, flags of `loadgen compare`, and the names that are simulated with them."""
    both = (("with-heartbeats", [], True), ("without-heartbeats", ["--no-heartbeats"], False))
    sorted_out = [
        (folder, flags, [name for name in names if LEFT_OUT[name].heartbeats is heartbeats])
        for folder, flags, heartbeats in both
    ]
    return [one for one in sorted_out if one[2]]


def table(found: Mapping[str, Mapping[str, Times]]) -> Table:
    """A line for each mechanism: its cost in each set, its largest loss and gain, and whether it stays."""
    names = [name for name in next(iter(found.values())) if name != NOTHING]
    columns = ["left out", *found, "largest loss", "largest gain", "stays"]
    rows = []
    for name in names:
        sets = {of: logs(times[name], times[NOTHING]) for of, times in found.items()}
        means = {of: _over_units(of, units) for of, units in sets.items()}
        single = [(unit, cost_of(each)) for units in sets.values() for unit, each in units.items()]
        single.sort(key=lambda one: one[1].mean)
        rows.append(
            [
                name,
                *map(str, means.values()),
                *(f"{unit} {cost}" for unit, cost in (single[-1], single[0])),
                "yes" if stays(list(means.values()), [cost for _, cost in single]) else "**no**",
            ]
        )
    units = ", ".join(f"{len({unit for unit, _ in of[NOTHING]})} {name}" for name, of in found.items())
    return Table(f"What it costs to leave out one mechanism, in percent of the time: {units}", columns, rows)


def logs(without: Times, whole: Times) -> dict[str, list[float]]:
    """The logarithms of the ratios of the same seeds or recordings, by scenario or family."""
    found: dict[str, list[float]] = {}
    for (unit, key), time in whole.items():
        found.setdefault(unit, []).append(float(np.log(without[unit, key] / time)))
    return found


def cost_of(ratios: Sequence[float]) -> Cost:
    """The geometric mean of ratios, given as logarithms, minus 1, with the interval of Student's t."""
    values = np.array(ratios)
    mean, half = float(values.mean()), np.nan
    if len(values) >= RATIOS_MIN:
        half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return Cost(*(float(np.expm1(one)) for one in (mean, mean - half, mean + half)))


def stays(means: Sequence[Cost], single: Sequence[Cost]) -> bool:
    """Whether a mechanism has earned its place."""
    return any(
        one.mean > least and one.low > 0
        for of, least in ((means, MEAN_COSTS), (single, ONE_COSTS))
        for one in of
    )


def _over_units(name: str, units: Mapping[str, list[float]]) -> Cost:
    """The cost in the mean of a set: scenarios are its units, and recordings are units of their own."""
    if name == RECORDINGS:
        return cost_of([value for each in units.values() for value in each])
    return cost_of([float(np.mean(each)) for each in units.values()])


def play_all(case: str, names: Sequence[str], seeds: Sequence[int], out: Path) -> Table:
    """Real runs of one case without each mechanism, in turns."""
    out.mkdir(parents=True, exist_ok=True)
    files = {
        heartbeats: out / f"{case}{'' if heartbeats else '-silent'}.toml" for heartbeats in (True, False)
    }
    for heartbeats, file in files.items():
        text = CASES[case].text()
        file.write_text(text if heartbeats else text.replace("[robot]\n", "[robot]\nheartbeats = false\n"))
    runs: dict[str, list[Played]] = {name: [] for name in names}
    for n, seed in enumerate(seeds):
        turn = n % len(names)
        for name in [*names[turn:], *names[:turn]]:
            one, folder = LEFT_OUT[name], out / f"{seed}-{name.replace(' ', '-')}"
            play(
                HERE,
                files[one.heartbeats],
                folder,
                policy=one.policy,
                predictor=one.predictor,
                seed=seed,
                tasks=CASES[case].tasks,
            )
            runs[name].append(read(folder))
    return table_of_runs(case, runs, NOTHING)


if __name__ == "__main__":
    sys.exit(main())
