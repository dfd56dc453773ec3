"""Plans a motion of a Panda arm around obstacles, by RRT with collision checks. Times have a heavy tail.

pyroboplan is Python that shares the interpreter lock, and draws from the one generator of numpy that all
threads use: run it with `cloud-server --executor processes`.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples import missing, run
from offboard import Offloader, task

try:
    from pyroboplan.core.utils import check_collisions_at_state
    from pyroboplan.models import panda
    from pyroboplan.planning import rrt
except ImportError as error:
    raise missing(__name__, "arm") from error

Array = np.ndarray[Any, Any]

JOINTS = 7
FINGERS_M = (0.04, 0.04)  # an open hand
CLEARANCE_M = 0.03  # of starts and goals; there is hardly a way out of a tighter place
PLANNING_S_MAX = 30.0  # long enough that no clock decides what the answer is

rrt.print = lambda *_: None  # the planner reports to stdout, which belongs to the program that calls it


@dataclass(frozen=True)
class Motion:
    """Waypoints of the joints, in radians, one in each row; no row if no path was found in time."""

    waypoints: Array
    samples: int  # that the search drew and tried to reach


class Planner(rrt.RRTPlanner):
    """Counts the samples: each costs collision checks, whether or not a tree can grow towards it."""

    samples = 0

    def extend_or_connect(self, *step: Any) -> Any:
        self.samples += 1
        return super().extend_or_connect(*step)


def load_planner() -> Planner:
    """The arm, its meshes and the obstacles around it. The wheel of pyroboplan contains them."""
    model, collisions, visuals = panda.load_models()
    panda.add_self_collisions(model, collisions)
    panda.add_object_collisions(model, collisions, visuals)
    options = rrt.RRTPlannerOptions(
        max_step_size=0.04,
        max_connection_dist=2.0,
        bidirectional_rrt=True,
        goal_biasing_probability=0.15,
        max_planning_time=PLANNING_S_MAX,
    )
    return Planner(model, collisions, options=options)


def distance(start: Array, goal: Array, seed: int) -> float:
    """How far the joints move, in radians. It is all that is known before the search."""
    del seed
    return float(np.linalg.norm(goal - start))


@task("plan_motion", setup=load_planner, size=distance, work=lambda motion: motion.samples, types=(Motion,))
def plan_motion(planner: Planner, start: Array, goal: Array, seed: int) -> Motion:
    """A path of the joints from start to goal that touches nothing; the seed draws the samples."""
    planner.options.rng_seed, planner.samples = seed, 0
    path = planner.plan(with_hand(start), with_hand(goal)) or []
    waypoints = np.array([q[:JOINTS] for q in path]).reshape(-1, JOINTS)
    return Motion(waypoints, max(planner.samples, 1))


def inputs(seed: int) -> Iterator[tuple[Array, Array, int]]:
    """Starts and goals without end, neither of them in collision."""
    rng, planner = np.random.default_rng(seed), load_planner()
    while True:
        yield free_joints(planner, rng), free_joints(planner, rng), int(rng.integers(2**31))


def same(a: Motion, b: Motion) -> bool:
    """Whether both found a path with the same ends.

    One thread finds the same path again. Several threads of a process share the generator of numpy, and then
    find different paths that are equally good.
    """
    if min(len(a.waypoints), len(b.waypoints)) == 0:
        return len(a.waypoints) == len(b.waypoints)
    return np.allclose(a.waypoints[[0, -1]], b.waypoints[[0, -1]], rtol=0, atol=1e-9)


def with_hand(joints: Array) -> Array:
    """The full state of the model: the joints of the arm and the fingers."""
    return np.concatenate((joints, FINGERS_M))


def free_joints(planner: Planner, rng: np.random.Generator) -> Array:
    """Random joints at which the arm keeps CLEARANCE_M from itself and from every obstacle."""
    low, high = planner.model.lowerPositionLimit[:JOINTS], planner.model.upperPositionLimit[:JOINTS]
    while True:
        joints = rng.uniform(low, high)
        state = with_hand(joints)
        if not check_collisions_at_state(
            planner.model, planner.collision_model, state, distance_padding=CLEARANCE_M
        ):
            return joints


def main(endpoint: str) -> None:
    """Call the task 30 times: `python -m examples.arm tcp://HOST:PORT`."""
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(plan_motion, 30.0)
        for start, goal, seed in itertools.islice(inputs(seed=1), 30):
            motion, record = offload.call(plan_motion, start, goal, seed)
            print(
                f"{len(motion.waypoints)} waypoints, {motion.samples} samples on {record.used}, "
                f"{record.waited_s * 1e3:.0f} ms ({record.decision.reason})"
            )


if __name__ == "__main__":
    run(main)
