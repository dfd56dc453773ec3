"""Finds the pose of a robot: registers a scan of its lidar with a map of the ground, by GICP.

small_gicp holds the interpreter lock while it computes: use `cloud-server --executor processes`. Points are
sent as whole steps of 2 mm, which is 6 bytes per point instead of 24.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples import missing, run
from offboard import Offloader, task

try:
    import small_gicp
except ImportError as error:
    raise missing(__name__, "registration") from error

Array = np.ndarray[Any, Any]
Known = tuple[small_gicp.PointCloud, small_gicp.KdTree]  # the map

MAP_POINTS = 200_000
MAP_HALF_M = 30.0  # the map is a square of 60 m
RANGE_M = (5.0, 25.0)  # how far the lidar sees: in a narrow place, many points share a voxel
STEP_M = 0.002
VOXEL_M = 0.1
POINTS = (5_000, 138_000)  # the fewest and the most points of a scan
GUESS_OFF_M = (0.02, 2.0)  # how far the guess is from the true pose: more work for the same payload
POSE_TOLERANCE = 0.01  # in metres, and in radians


@dataclass(frozen=True)
class Match:
    """Where a scan was taken: a 4 x 4 pose in the map, and what the search for it took."""

    pose: Array
    converged: bool
    iterations: int
    points: int  # that were left of the scan, one per voxel


def ground(xy: Array) -> Array:
    """Points of hilly ground at these places."""
    x, y = xy.T
    z = np.sin(x / 3) + np.cos(y / 4) + 0.4 * np.sin(x * 1.3) * np.cos(y * 0.9)
    return np.column_stack((xy, z))


def load_map() -> Known:
    """The map and its search tree. A real robot loads them from a file that the server has too."""
    places = np.random.default_rng(0).uniform(-MAP_HALF_M, MAP_HALF_M, (MAP_POINTS, 2))
    cloud, tree = small_gicp.preprocess_points(ground(places), VOXEL_M, num_threads=1)
    return cloud, tree


def work(match: Match) -> float:
    """Each iteration looks up each point in the tree. Range and guess decide how many look-ups there are."""
    return (match.iterations + 1) * match.points


@task("register_scan", setup=load_map, size=lambda scan, _: len(scan), work=work, types=(Match,))
def register_scan(known: Known, scan: Array, guess: Array) -> Match:
    """The pose from which `scan` was taken (3 columns, in steps of 2 mm); `guess` is a pose near it."""
    cloud, tree = known
    source, _ = small_gicp.preprocess_points(scan * STEP_M, VOXEL_M, num_threads=1)
    found = small_gicp.align(cloud, source, tree, guess, max_correspondence_distance=2.0, num_threads=1)
    return Match(found.T_target_source, found.converged, found.iterations, source.size())


def inputs(seed: int, points: tuple[int, int] = POINTS) -> Iterator[tuple[Array, Array]]:
    """Scans and guesses without end. Points, range and error of the guess are drawn independently."""
    rng = np.random.default_rng(seed)
    while True:
        count = int(np.exp(rng.uniform(*np.log(points))))
        pose = pose_at(rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(-np.pi, np.pi))
        off_m = np.exp(rng.uniform(*np.log(GUESS_OFF_M)))
        angle = rng.uniform(-np.pi, np.pi)
        guess = pose @ pose_at(off_m * np.cos(angle), off_m * np.sin(angle), 0.05 * off_m)
        yield draw_scan(count, rng.uniform(*RANGE_M), pose, rng), guess


def same(a: Match, b: Match) -> bool:
    """Whether both poses agree. Threads and CPUs round differently, so equal bits are not required."""
    return a.converged == b.converged and np.allclose(a.pose, b.pose, rtol=0, atol=POSE_TOLERANCE)


def pose_at(x: float, y: float, yaw: float) -> Array:
    """A pose on flat ground, as a 4 x 4 matrix."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]], float)


def draw_scan(count: int, range_m: float, pose: Array, rng: np.random.Generator) -> Array:
    """Ground within a range of a pose, as the lidar there sees it, with 1 cm of noise."""
    angle, distance = rng.uniform(-np.pi, np.pi, count), range_m * np.sqrt(rng.uniform(0, 1, count))
    places = np.column_stack((distance * np.cos(angle), distance * np.sin(angle))) + pose[:2, 3]
    seen = ground(places) + rng.normal(0, 0.01, (count, 3))
    return np.rint((seen - pose[:3, 3]) @ pose[:3, :3] / STEP_M).astype(np.int16)


def main(endpoint: str) -> None:
    """Call the task 30 times: `python -m examples.registration tcp://HOST:PORT`."""
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(register_scan, 30.0)
        for scan, guess in itertools.islice(inputs(seed=1), 30):
            match, record = offload.call(register_scan, scan, guess)
            print(
                f"{len(scan)} points, {scan.nbytes / 1e3:.0f} kB: {match.iterations} iterations on "
                f"{record.used}, {record.waited_s * 1e3:.0f} ms ({record.decision.reason})"
            )


if __name__ == "__main__":
    run(main)
