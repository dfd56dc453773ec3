"""The tasks of `benchmarks.pipeline`, and its robot: it finds tags, follows them, and plans to the nearest.

The robot makes each round twice, on the same frame: once with a decision for each step, and once as one task.
It is started by a testbed, so that its CPU is limited and its link is a recording.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from examples import apriltags
from offboard import Offloader, Record, task
from offboard.common.command_line import run_command
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, plan_path, warm

PROG = "python -m benchmarks.pipeline_robot"
STEPS, WHOLE = "step by step", "as one task"
CONNECT_S = 60.0
SHAPES = ((480, 640), (720, 1280), (1080, 1920))  # rows, columns of the frames
MAP = Path(__file__).parents[1] / "maps" / "willow-full-0.05.yaml"
NEAR_PIXELS = 200.0  # a detection this near to where its track should be belongs to it
KEPT_FRAMES = 5  # for which a track is kept without a detection
GAIN = 0.6  # of a new position in a track, as in an alpha-beta filter; half of it for the speed

Array = np.ndarray[Any, Any]
Detections = list[dict[str, Any]]
Tracks = list[dict[str, Any]]


@task("pipeline_track", size=lambda found, tracks: len(found) * len(tracks))
def follow_tags(found: Detections, tracks: Tracks) -> Tracks:
    """The tracks after one more frame: an alpha-beta filter for the tag of each number."""
    seen, kept = {one["id"]: np.array(one["center"]) for one in found}, []
    for track in tracks:
        place = np.array(track["center"]) + track["speed"]
        speed, missed = np.array(track["speed"]), track["missed"] + 1
        if track["id"] in seen and np.hypot(*(seen[track["id"]] - place)) < NEAR_PIXELS:
            error = seen.pop(track["id"]) - place
            place, speed, missed = place + GAIN * error, speed + GAIN / 2 * error, 0
        if missed <= KEPT_FRAMES and track["id"] not in seen:
            kept.append(_track(track["id"], place, speed, missed))
    new = [_track(number, place, np.zeros(2)) for number, place in seen.items()]
    return sorted([*kept, *new], key=lambda track: track["id"])


def _track(number: int, place: Array, speed: Array, missed: int = 0) -> dict[str, Any]:
    return {"id": number, "center": place.tolist(), "speed": speed.tolist(), "missed": missed}


@task(
    "pipeline_whole",
    setup=apriltags.make_detector,
    size=lambda frame, *_: apriltags.pixels(frame),  # where the plan goes is not known yet
    types=(GridMap, Pose, Point, Plan),
    warm=warm,
    covers=["../examples/apriltags.py"],
)
def run_pipeline(detector: Any, frame: Any, tracks: Tracks, grid: GridMap, pose: Pose) -> tuple[Tracks, Plan]:
    """All steps in one place: what the robot gets is the new tracks and the path."""
    tracks = follow_tags(apriltags.detect_tags(detector, frame), tracks)
    return tracks, plan_path(grid, None, pose, shelf(grid, nearest(tracks)))


def nearest(tracks: Tracks) -> int:
    """The number of the tag that is lowest in the picture; 0 without one."""
    return int(max(tracks, key=lambda track: track["center"][1])["id"]) if tracks else 0


def shelf(grid: GridMap, number: int) -> Point:
    """Where the shelf of a tag is: a free cell that its number draws."""
    random = np.random.default_rng(number)
    while grid.cells[place := tuple(random.integers(grid.cells.shape))] != 0:
        pass
    (x, y) = grid.metres(np.array([place]))[0]
    return Point(float(x), float(y))


def main() -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__)
    parser.add_argument("doing", choices=["rounds"])
    for name in ("cloud", "lines"):
        parser.add_argument(f"--{name}", required=True)
    for name in ("seed", "tasks"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--timeout", type=float, required=True)
    flags = parser.parse_args()
    with (
        Offloader.connect(flags.cloud, timeout_s=flags.timeout) as steps,
        Offloader.connect(flags.cloud, timeout_s=flags.timeout) as whole,
        Path(flags.lines).open("w", buffering=1) as file,
    ):
        for function in (apriltags.detect_tags, follow_tags, plan_path):
            steps.wait_for_sites(function, CONNECT_S)
        whole.wait_for_sites(run_pipeline, CONNECT_S)
        for line in rounds({STEPS: steps, WHOLE: whole}, flags.seed, flags.tasks):
            file.write(json.dumps(line) + "\n")
    return 0


def rounds(offload: Mapping[str, Offloader], seed: int, count: int) -> Iterator[dict[str, Any]]:
    """What each way of asking took in each round; each way comes first in every other round.

    Each way has an offloader of its own, so that neither learns or saves bytes by the other.
    """
    grid, random = read_map(MAP), np.random.default_rng(seed)
    ways = {STEPS: step_by_step, WHOLE: as_one_task}
    tracks: dict[str, Tracks] = {way: [] for way in ways}
    for number, (frame,) in enumerate(islice(apriltags.inputs(seed, SHAPES), count)):
        at = shelf(grid, int(random.integers(1 << 30)))
        pose, paths = Pose(at.x, at.y), {}
        for way in ways if number % 2 else reversed(ways):
            began_s = time.perf_counter()
            tracks[way], plan, records = ways[way](offload[way], frame, tracks[way], grid, pose)
            seconds, paths[way] = time.perf_counter() - began_s, plan
            yield {
                "round": number,
                "way": way,
                "seconds": seconds,
                "sites": [record.used for record in records],
                "runs": sum(len(record.executions) for record in records),
                "bytes": sum(run.bytes_out + run.bytes_in for record in records for run in record.executions),
            }
        if tracks[STEPS] != tracks[WHOLE] or paths[STEPS].cost != paths[WHOLE].cost:
            raise AssertionError(f"round {number}: both ways must find the same")


def step_by_step(
    offload: Offloader, frame: Any, tracks: Tracks, grid: GridMap, pose: Pose
) -> tuple[Tracks, Plan, Sequence[Record]]:
    """Each step is decided by itself; its result comes back to the robot."""
    found, detected = offload.call(apriltags.detect_tags, frame)
    tracks, followed = offload.call(follow_tags, found, tracks)
    plan, planned = offload.call(plan_path, grid, None, pose, shelf(grid, nearest(tracks)))
    return tracks, plan, (detected, followed, planned)


def as_one_task(
    offload: Offloader, frame: Any, tracks: Tracks, grid: GridMap, pose: Pose
) -> tuple[Tracks, Plan, Sequence[Record]]:
    (tracks, plan), record = offload.call(run_pipeline, frame, tracks, grid, pose)
    return tracks, plan, (record,)


if __name__ == "__main__":
    sys.exit(run_command(PROG, main))
