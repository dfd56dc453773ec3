"""A policy for streams of actions that takes as long as its observation says, as a network on an accelerator.

It follows a target that moves on smooth curves drawn from a seed. Each chunk goes on from the place and speed
of the target that it was shown. Robot and server load it with `offboard.loadgen.robot.stream_policy`.
"""

import math
import random
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.tasks import task

NOISE = 0.1  # standard deviation of the logarithm of how long the policy takes
WAVES, PERIOD_S = 3, (4.0, 16.0)
DIMENSIONS = 2
QUALITY = {"onboard": 0.5, "cloud": 1.0}

Floats = NDArray[np.float64]
Observation = dict[str, Any]


def followed(observation: Observation) -> Floats:
    """Where the target goes, if it keeps its speed."""
    ahead_s = np.arange(observation["horizon"]) / observation["hz"]
    place, speed = (np.asarray(observation[name]) for name in ("place", "speed"))
    return np.asarray(place + np.outer(ahead_s, speed), dtype=np.float64)


def follow_onboard(observation: Observation) -> Floats:
    time.sleep(observation["onboard_s"])
    return followed(observation)


@task("follow", size=lambda _: 0.0, variants={"onboard": follow_onboard}, quality=QUALITY)
def follow(observation: Observation) -> Floats:
    """The actions of the next steps, of shape (horizon, DIMENSIONS)."""
    time.sleep(observation["cloud_s"])
    return followed(observation)


def target(seed: int) -> Callable[[float], tuple[Floats, Floats]]:
    """Where the target is at a time, and its speed."""
    draw = np.random.default_rng(seed)
    turns = 2 * math.pi / draw.uniform(*PERIOD_S, (WAVES, DIMENSIONS))
    starts = draw.uniform(0.0, 2 * math.pi, (WAVES, DIMENSIONS))

    def at(now_s: float) -> tuple[Floats, Floats]:
        angles = turns * now_s + starts
        return np.sin(angles).sum(0), (turns * np.cos(angles)).sum(0)

    return at


def observations(hz: float, horizon: int, run_s: Mapping[str, float], seed: int) -> Iterator[Observation]:
    """What a robot sees at each step, and how long the policy takes for it on each site of `run_s`."""
    draws = {site: random.Random(f"{seed} {site}") for site in run_s}
    seen = target(seed)
    step = 0
    while True:
        place, speed = seen(step / hz)
        yield {
            **{f"{site}_s": run_s[site] * math.exp(draws[site].gauss(0.0, NOISE)) for site in run_s},
            **{"hz": hz, "horizon": horizon, "place": place.tolist(), "speed": speed.tolist()},
        }
        step += 1
