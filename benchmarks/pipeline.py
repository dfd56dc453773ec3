"""Measures what a pipeline of dependent steps loses if each step is placed by itself, on recorded links.

    .cache/examples/bin/python -m benchmarks.pipeline

The steps are to find AprilTags in a frame, to follow them, and to plan to the nearest. Each round is made
twice, step by step and as one task. A run that was played stays in --out and is read again.
"""

import argparse
import os
import platform
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Table, processor
from benchmarks.pipeline_robot import STEPS, WHOLE
from offboard.common.command_line import run_command
from offboard.common.errors import OffloadError
from offboard.loadgen.play.machine import commit_here
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.table.confidence_intervals import Blocks, Picks
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_two_figures import quantile
from offboard.loadgen.testbed.local_testbed import COMMANDS, LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Setup

PROG = "python -m benchmarks.pipeline"
LINKS = Path("loadgen/links")
RECORDINGS = {
    "5G in a town": "5g/5g-town.csv",
    "a viewer of videos": "video/video-viewer.csv",
    "3G on a tram": "3g/3g-tram.csv",
}
TASKS = "benchmarks.pipeline_robot,offboard.common.planning.planner"
ROBOT_COMMAND = (sys.executable, "-m", "benchmarks.pipeline_robot")
ROBOT_CPUS, CLOUD_CPUS = 0.3, 1.0
DELAY_MS, BANDWIDTH_MBPS = 15.0, 100.0  # what a recording does not hold
TIMEOUT_S = 10.0
FROM_ROUND = 10  # before it, most steps run on both sites
RUN_S_MAX = 3600.0

Line = Mapping[str, Any]


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=150, help="rounds on each link (150)")
    parser.add_argument("--seed", type=int, default=1, help="of frames, places and link (1)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/pipeline"), help="folder of the runs (%(default)s)"
    )
    flags = parser.parse_args(argv)
    print(f"{processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, ", end="")
    print(f"commit {commit_here() or 'unknown'}, seed {flags.seed}\n")
    runs = {name: play(name, rounds=flags.rounds, seed=flags.seed, out=flags.out) for name in RECORDINGS}
    print(table(runs))
    return 0


def play(link: str, *, rounds: int, seed: int, out: Path) -> list[Line]:
    """The lines of the run over this link, which is played unless it was played whole before."""
    folder = out / f"{Path(RECORDINGS[link]).stem}-{seed}-{rounds}"
    lines, whole = folder / "lines.jsonl", folder / "whole"
    if not whole.exists():
        print(f"{link}: {rounds} rounds", file=sys.stderr, flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        relay = {"recording": (LINKS / RECORDINGS[link]).resolve(), "delay_ms": DELAY_MS}
        robot = {"lines": lines, "seed": seed, "tasks": rounds, "timeout": TIMEOUT_S}
        parts = {
            CLOUD: Setup({"tasks": TASKS}, CLOUD_CPUS),
            WAN: Setup({**relay, "bandwidth_mbps": BANDWIDTH_MBPS, "seed": seed}),
            ROBOT: Setup(robot, ROBOT_CPUS, command="rounds"),
        }
        with LocalTestbed(folder, parts, commands={**COMMANDS, ROBOT: ROBOT_COMMAND}) as bed:
            bed.start()
            bed.start(ROBOT)
            if (code := bed.wait(ROBOT, RUN_S_MAX)) != 0:
                raise OffloadError(f"the robot ended with exit code {code}; see {folder / 'logs'}")
        whole.touch()
    return list(read_lines(lines))


def table(runs: Mapping[str, Sequence[Line]]) -> Table:
    rows = []
    for link, lines in runs.items():
        by_way = {way: [one for one in lines if one["way"] == way][FROM_ROUND:] for way in (STEPS, WHOLE)}
        seconds = {way: np.array([one["seconds"] for one in found]) for way, found in by_way.items()}
        rows += [_row(link, way, found, seconds) for way, found in by_way.items()]
    return Table(
        f"Three dependent steps: robot {ROBOT_CPUS:g} CPU, cloud {CLOUD_CPUS:g} CPU",
        ("link", "way", "mean ms", "P95 ms", "of one task", "answered by the cloud", "runs", "kB"),
        rows,
    )


def _row(link: str, way: str, lines: Sequence[Line], seconds: Mapping[str, Column]) -> tuple[str, ...]:
    both = np.array([seconds[way], seconds[WHOLE]])

    def of_one_task(picks: Picks) -> Column:
        found: Column = both[0][picks].mean(-1) / both[1][picks].mean(-1)
        return found

    ratio = "1"
    if way == STEPS:
        low, high = Blocks(both.shape[1]).interval(of_one_task)
        value = both[0].mean() / both[1].mean()
        ratio = f"{value:.2f}" if low is None or high is None else f"{value:.2f} [{low:.2f}, {high:.2f}]"
    names = ("find", "follow", "plan") if way == STEPS else ("all",)
    used = [Counter(line["sites"][at] for line in lines) for at in range(len(names))]
    shares = (f"{name} {100 * one[CLOUD] / len(lines):.0f} %" for name, one in zip(names, used, strict=True))
    return (
        link,
        way,
        f"{1e3 * seconds[way].mean():.0f}",
        f"{1e3 * quantile(seconds[way], 95):.0f}",
        ratio,
        ", ".join(shares),
        f"{np.mean([line['runs'] for line in lines]):.2f}",
        f"{np.mean([line['bytes'] for line in lines]) / 1e3:.0f}",
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
