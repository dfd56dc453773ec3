"""Simulates streams of actions over recorded links: empty steps, age, seams and forecasts by rule.

    python -m benchmarks.streams FOLDER_OF_RECORDINGS [--cloud-ms 100] [--onboard-ms 350] [--hz 30]

A recording is CSV with `t_s,rtt_ms`; the name up to the first `-` is its group. The scenario is that of
`loadgen run`, as long as the recording. Steps before the first chunk do not count.
"""

import argparse
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from benchmarks.measure import Requirement, Table
from offboard.loadgen.relay.link.recording_file import read_recording
from offboard.loadgen.rivals.stream_rules import DELAYS, STREAM
from offboard.loadgen.robot.config import STREAM_TASK
from offboard.loadgen.robot.stream_policy import target
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import CloudPart, RobotPart, Scenario, Workload
from offboard.loadgen.simulation.model.task_costs import find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.records.record import ChunkRecord, Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.robot_client.streams.asking import BLEND

S_PER_QUALITY = 1.0  # what the quality that the onboard policy loses is worth is half of this
WORKERS = 2  # of the server: a chunk that is given up does not delay the next one
RESAMPLES = 2000
BLENDS = (0, 2, 6, 12)
HALF = " (half a horizon)"


@dataclass(frozen=True)
class Drive:
    """One recording, and what is played on it."""

    path: Path
    steps: int
    hz: float = 30.0
    horizon: int = 50
    cloud_ms: float = 100.0
    onboard_ms: float = 350.0
    seed: int = 1
    from_s: float = 0.0

    @property
    def group(self) -> str:
        return self.path.stem.partition("-")[0]

    def scenario(self, rule: str, calls_per_s: float | None = None, blend: int = BLEND) -> Scenario:
        link: dict[str, Any] = {"recording": self.path, "recording_from_s": self.from_s}
        return Scenario(
            self.path.stem,
            self.seed,
            Workload(
                task=STREAM_TASK,
                tasks=self.steps,
                stream_hz=self.hz,
                stream_horizon=self.horizon,
                stream_calls_per_s=calls_per_s,
                stream_blend=blend,
                stream_onboard_ms=self.onboard_ms,
                stream_cloud_ms=self.cloud_ms,
            ),
            robot=RobotPart(policy=rule, cpus=1.0, s_per_quality=S_PER_QUALITY),
            servers=(CloudPart(workers=WORKERS),),
            link={**link, "bandwidth_mbps": 0.0, "delay_ms": 0.0},
        )


def drives(folder: Path, **settings: Any) -> list[Drive]:
    """The recordings of a folder that hold round trips."""
    found = []
    for path in sorted(folder.glob("*.csv")):
        recording = read_recording(path)
        if "rtt_ms" in recording.columns:
            hz = settings.get("hz", Drive.hz)
            found.append(Drive(path, int(recording.times[-1] * hz), **settings))
    return found


@dataclass
class Played:
    """What one rule did on one recording, or on several."""

    steps: int = 0
    empty: int = 0
    age_s: float = 0.0  # of all steps that had an action
    seconds: float = 0.0
    asked: dict[str, int] = field(default_factory=lambda: {CLOUD: 0, ONBOARD: 0})
    forecasts: list[tuple[bool, int]] = field(default_factory=list)  # late, and how many steps too many
    seams: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    @property
    def empty_percent(self) -> float:
        return 100.0 * self.empty / self.steps if self.steps else 0.0

    @property
    def age_ms(self) -> float:
        return 1e3 * self.age_s / max(1, self.steps - self.empty)

    def per_second(self, site: str) -> float:
        return self.asked[site] / self.seconds if self.seconds else 0.0

    def add(self, other: "Played") -> None:
        for name in ("steps", "empty", "age_s", "seconds", "forecasts", "seams", "errors"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for site, count in other.asked.items():
            self.asked[site] += count


class Chunks(list[tuple[str, ChunkRecord]]):
    """Keeps the chunks of a run, by the site that was asked."""

    def write(self, record: Record) -> None:
        if record.chunk is not None:
            self.append((record.decision.site, record.chunk))


def played_of(outcome: Outcome, drive: Drive) -> Played:
    """The steps of a run from the first fresh action on."""
    steps = list(itertools.dropwhile(lambda one: one.step.held, outcome.answered))
    fresh = [one for one in steps if not one.step.held]
    at = target(drive.seed)
    return Played(
        steps=len(steps),
        empty=len(steps) - len(fresh),
        age_s=sum(one.step.age_s for one in fresh),
        seconds=len(steps) / drive.hz,
        seams=[one.step.seam for one in steps if one.step.seam is not None],
        errors=[
            float(np.linalg.norm(np.subtract(one.answer["action"], at(one.i / drive.hz)[0]))) for one in fresh
        ],
    )


def play(case: tuple[Drive, str, float | None, int]) -> Played:
    """A stream with this rule, limit of questions and blend."""
    drive, rule, calls_per_s, blend = case
    scenario, chunks = drive.scenario(rule, calls_per_s, blend), Chunks()
    tasks = {ROBOT: find_tasks(scenario.workload, drive.seed, drive.steps)}
    outcome = simulate(scenario, tasks, trace=chunks)  # type: ignore[arg-type]
    played = played_of(outcome, drive)
    for site, chunk in chunks:
        played.asked[site] += 1
        if site == CLOUD and chunk.expected_s is not None and chunk.outcome != "failed":
            forecast = min(drive.horizon, math.ceil(chunk.expected_s * drive.hz))
            lost = chunk.outcome == "lost"
            true = drive.horizon + 1 if lost else math.ceil(chunk.arrived_s * drive.hz)
            played.forecasts.append((true > forecast, max(0, forecast - true)))
    return played


def rules(drive: Drive) -> dict[str, tuple[str, float | None, int]]:
    """Name, limit of questions and blend of each row."""
    per_half = 2.0 * drive.hz / drive.horizon
    return {
        **{name: (name, None, 0) for name in ("broker", "half-empty", "fixed-interval")},
        **{f"{name}{HALF}": (name, per_half, BLEND) for name in DELAYS},
        "stream (often)": (STREAM, 2.5 * per_half, BLEND),
        "stream (no limit)": (STREAM, drive.hz, BLEND),
        **{f"stream (blend {steps})": (STREAM, None, steps) for steps in BLENDS},
    }


def tables(found: Sequence[Drive]) -> Iterator[Table]:
    groups = ["all", *sorted({one.group for one in found})]
    named = rules(found[0])
    cases = [(drive, *row) for row in named.values() for drive in found]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        played = list(pool.map(play, cases, chunksize=4))
    of = dict(zip(named, batches(played, len(found)), strict=True))
    sums = {(name, group): Played() for name in named for group in groups}
    for name, some in of.items():
        for drive, one in zip(found, some, strict=True):
            sums[name, "all"].add(one)
            sums[name, drive.group].add(one)
    yield _steps_table(of, sums, groups)
    yield _forecast_table(of, sums, groups)
    rows = []
    for steps in BLENDS:
        one = sums[f"stream (blend {steps})", "all"]
        figures = fmean(one.seams), fmean(one.errors), np.quantile(one.errors, 0.95)
        rows.append([str(steps), *(f"{figure:.4f}" for figure in figures)])
    yield Table("Seams", ["blend, steps", "seam", "distance to the target", "its 95 % quantile"], rows)


def batches(played: Sequence[Played], size: int) -> list[Sequence[Played]]:
    return [played[first : first + size] for first in range(0, len(played), size)]


def _steps_table(
    of: Mapping[str, Sequence[Played]], sums: Mapping[tuple[str, str], Played], groups: Sequence[str]
) -> Table:
    rows = []
    for name, some in of.items():
        whole = sums[name, "all"]
        rows.append([
            name,
            *(f"{sums[name, group].empty_percent:.2f}" for group in groups),
            interval([one.empty_percent for one in some]),
            f"{whole.age_ms:.0f}",
            f"{whole.per_second(CLOUD):.2f}",
            f"{whole.per_second(ONBOARD):.2f}",
        ])  # fmt: skip
    columns = [
        "rule", *(f"empty % {group}" for group in groups), "mean of recordings", "age ms",
        "server chunks/s", "onboard chunks/s",
    ]  # fmt: skip
    count = len(next(iter(of.values())))
    return Table(f"Streams on {count} recordings", columns, rows, _required(sums, groups))


def _required(sums: Mapping[tuple[str, str], Played], groups: Sequence[str]) -> list[Requirement]:
    same, rival = sums[f"stream{HALF}", "all"], sums["half-empty", "all"]
    every, unlimited = sums["fixed-interval", "all"], sums["stream (no limit)", "all"]
    found = [
        Requirement("empty steps over half-empty's", same.empty_percent / rival.empty_percent, 0.2),
        Requirement("empty steps over fixed-interval's", same.empty_percent / every.empty_percent, 0.2),
        Requirement(
            "server chunks over half-empty's", same.per_second(CLOUD) / rival.per_second(CLOUD), 1.02
        ),
        Requirement("age without a limit over half-empty's", unlimited.age_ms / rival.age_ms, 0.65),
    ]
    if "rural" in groups:
        rural = [sums[name, "rural"].empty_percent for name in (f"stream{HALF}", "half-empty")]
        found.append(Requirement("empty steps over half-empty's, rural", rural[0] / rural[1], 0.05))
    return found


def _forecast_table(
    of: Mapping[str, Sequence[Played]], sums: Mapping[tuple[str, str], Played], groups: Sequence[str]
) -> Table:
    rows, own = [], (0.0, 0.0)
    for name in (f"{delay}{HALF}" for delay in DELAYS):
        told = {group: forecast_of(sums[name, group]) for group in groups}
        rates = [forecast_of(one)[0] for one in of[name] if one.forecasts]
        rows.append([name, *(f"{late:.2f}, {steps:.1f}" for late, steps in told.values()), interval(rates)])
        own = told["all"] if name.startswith(STREAM) else own
    columns = [
        "rule",
        *(f"late %, steps too many: {group}" for group in groups),
        "late %, mean of recordings",
    ]
    return Table("Forecasts of arrival", columns, rows, [
        Requirement("late chunks", own[0], 0.7, "%", at_least=True),
        Requirement("late chunks", own[0], 1.5, "%"),
        Requirement("steps too many", own[1], 2.5),
    ])  # fmt: skip


def forecast_of(played: Played) -> tuple[float, float]:
    """The percentage of chunks that came late, and how many steps too long the forecasts were on average."""
    late, steps = zip(*played.forecasts, strict=True)
    return 100.0 * fmean(late), fmean(steps)


def interval(values: Sequence[float]) -> str:
    """The mean over recordings, with its 95 % interval by the bootstrap."""
    picks = np.random.default_rng(1).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.quantile(np.asarray(values)[picks].mean(axis=1), (0.025, 0.975))
    return f"{fmean(values):.2f} [{low:.2f}, {high:.2f}]"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.streams", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    for name in ("cloud_ms", "onboard_ms", "hz"):
        usual = getattr(Drive, name)
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=float, default=usual, help=f"(default: {usual:g})"
        )
    parser.add_argument("--horizon", type=int, default=Drive.horizon, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=Drive.seed, help="(default: %(default)s)")
    flags = vars(parser.parse_args())
    folder = flags.pop("folder")
    found = drives(folder, **flags)
    if not found:
        parser.error(f"{folder}: no recording with t_s,rtt_ms")
    for table in tables(found):
        print(table)


if __name__ == "__main__":
    main()
