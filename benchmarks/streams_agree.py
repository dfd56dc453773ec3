"""Plays streams over recorded links on real processes, and the same in simulation.

    python -m benchmarks.streams_agree FOLDER_OF_RECORDINGS [--count 10] [--seconds 100]

Of each recording the last seconds are played. The rules are that of the product, and asking the server when
the queue is half empty. The recordings are those on which the second rule has most empty steps.
"""

import argparse
import itertools
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from benchmarks.measure import Requirement, Table
from benchmarks.streams import Drive, Played, drives, played_of
from benchmarks.streams import play as simulated
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.relay.link.recording_file import read_recording
from offboard.robot_client.streams.asking import BLEND

RULES = ("stream", "half-empty")
AT_ONCE = 4  # robots; their policies sleep
POINTS, SHARE = 0.2, 0.1  # by which real and simulated empty steps may differ


def real(rule: str, drive: Drive) -> Played:
    """One robot on real processes."""
    with tempfile.TemporaryDirectory() as out:
        return played_of(play(drive.scenario(rule), Path(out), quiet=True).outcome, drive)


def last(drive: Drive, seconds: float) -> Drive:
    """The end of a recording."""
    from_s = max(0.0, read_recording(drive.path).times[-1] - seconds)
    return replace(drive, from_s=from_s, steps=min(drive.steps, int(seconds * drive.hz)))


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.streams_agree", description=__doc__.splitlines()[0]
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=10, help="recordings (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=100.0, help="of each (default: %(default)s)")
    flags = parser.parse_args()
    with ProcessPoolExecutor(AT_ONCE, mp_context=get_context("spawn")) as pool:
        found = drives(flags.folder)
        empty = list(pool.map(simulated, [(drive, "half-empty", None, BLEND) for drive in found]))
        worst = sorted(zip(found, empty, strict=True), key=lambda pair: -pair[1].empty)
        chosen = [last(drive, flags.seconds) for drive, _ in worst[: flags.count]]
        cases = list(itertools.product(chosen, RULES))
        model = pool.map(simulated, [(drive, rule, None, BLEND) for drive, rule in cases])
        played = pool.map(real, [rule for _, rule in cases], [drive for drive, _ in cases])
        pairs = list(zip(cases, played, model, strict=True))
    rows, totals = [], {(rule, how): Played() for rule in RULES for how in ("real", "simulated")}
    for (drive, rule), *both in pairs:
        for how, one in zip(("real", "simulated"), both, strict=True):
            totals[rule, how].add(one)
        rows.append([
            drive.path.stem, rule, *(f"{one.empty_percent:.2f}, {one.age_ms:.0f}" for one in both)
        ])  # fmt: skip
    for rule in RULES:
        both = [totals[rule, how] for how in ("real", "simulated")]
        rows.append(["all", rule, *(f"{one.empty_percent:.2f}, {one.age_ms:.0f}" for one in both)])
    share = {case: total.empty_percent for case, total in totals.items()}
    stream = abs(share["stream", "real"] - share["stream", "simulated"])
    half = abs(share["half-empty", "real"] / max(1e-9, share["half-empty", "simulated"]) - 1.0)
    columns = ["recording", "rule", "real: empty %, age ms", "simulated: empty %, age ms"]
    print(Table("Streams on real processes and in simulation", columns, rows, [
        Requirement("stream: empty steps, real - simulated", stream, POINTS, "points"),
        Requirement("half-empty: empty steps, real / simulated - 1", half, SHARE),
    ]))  # fmt: skip


if __name__ == "__main__":
    main()
