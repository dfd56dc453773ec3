"""Optimises the pose graph of a SLAM back end. The graph grows during the mission, and so does the time.

gtsam holds the interpreter lock while it optimises: use `cloud-server --executor processes`. The measurements
are those of the data set w10000, which the wheel of gtsam contains.
"""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from examples import missing, run
from offboard import Offloader, task

try:
    import gtsam
except ImportError as error:
    raise missing(__name__, "pose-graph") from error

Array = np.ndarray[Any, Any]

POSES = (250, 8_000)  # at the first and at the last call of a mission
CALLS = 60  # of a mission
POSE_TOLERANCE = 1e-3  # in metres, and in radians


@dataclass(frozen=True)
class Optimised:
    """The poses that fit the measurements best: x, y and yaw in each row."""

    poses: Array
    error: float
    iterations: int
    edges: int


def work(result: Optimised) -> float:
    """Each iteration linearises each edge. The answer alone says how many iterations there were."""
    return result.iterations * result.edges


@task("optimise_graph", size=lambda poses, pairs, moves: len(pairs), work=work, types=(Optimised,))  # noqa: ARG005
def optimise_graph(poses: Array, pairs: Array, moves: Array) -> Optimised:
    """Fit `poses` to measured moves: row k of `moves` (x, y, yaw) leads from one pose of pair k to the other.

    The task has no engine and no state, so it needs no `setup`.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    unit = gtsam.noiseModel.Unit.Create(3)
    for number, pose in enumerate(poses.tolist()):
        start.insert(number, gtsam.Pose2(*pose))
    for (a, b), move in zip(pairs.tolist(), moves.tolist(), strict=True):
        graph.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*move), unit))
    graph.add(gtsam.PriorFactorPose2(0, start.atPose2(0), unit))  # without it, the graph could float
    optimizer = gtsam.GaussNewtonOptimizer(graph, start)
    found = gtsam.utilities.extractPose2(optimizer.optimize())
    return Optimised(found.astype(np.float32), optimizer.error(), optimizer.iterations(), len(pairs))


def inputs(
    seed: int, poses: tuple[int, int] = POSES, calls: int = CALLS
) -> Iterator[tuple[Array, Array, Array]]:
    """The graph at each call of a mission; the seed draws when the calls come. It ends after `calls`."""
    start, pairs, moves = load_graph()
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.5, 1.5, calls)
    shares = (np.cumsum(steps) - steps[0]) / max(steps[1:].sum(), 1e-9)
    for share in shares:
        count = round(poses[0] + share * (poses[1] - poses[0]))
        known = pairs.max(axis=1) < count
        yield start[:count], pairs[known], moves[known]


def same(a: Optimised, b: Optimised) -> bool:
    """Whether both answers hold the same poses. Yaw may differ by a full turn."""
    if a.poses.shape != b.poses.shape:
        return False
    apart = a.poses - b.poses
    apart[:, 2] = np.angle(np.exp(1j * apart[:, 2]))
    return bool(np.abs(apart).max() <= POSE_TOLERANCE)


@functools.cache
def load_graph() -> tuple[Array, Array, Array]:
    """First guesses of all poses, pairs of poses, and the moves between them, from the file in the wheel."""
    vertices, pairs, moves = [], [], []
    for line in Path(gtsam.findExampleDataFile("w10000.graph")).read_text().splitlines():
        kind, *words = line.split()
        if kind == "VERTEX2":
            vertices.append([float(word) for word in words[1:4]])
        elif kind == "EDGE2":
            pairs.append([int(word) for word in words[:2]])
            moves.append([float(word) for word in words[2:5]])
    return np.array(vertices, np.float32), np.array(pairs, np.int32), np.array(moves, np.float32)


def main(endpoint: str) -> None:
    """Play one mission: `python -m examples.pose_graph tcp://HOST:PORT`."""
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(optimise_graph, 30.0)
        for poses, pairs, moves in itertools.islice(inputs(seed=1), CALLS):
            result, record = offload.call(optimise_graph, poses, pairs, moves)
            print(
                f"{len(poses)} poses, {len(pairs)} edges: {result.iterations} iterations on {record.used}, "
                f"{record.waited_s * 1e3:.0f} ms ({record.decision.reason})"
            )


if __name__ == "__main__":
    run(main)
