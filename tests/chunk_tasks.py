"""A policy whose actions say for which step they are, which site has made them, and what it had seen."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard import task

HORIZON = 25
BAD = {"nan": np.full((HORIZON, 3), np.nan), "none": np.empty((0, 3)), "other": np.zeros((HORIZON, 2))}


def chunk(observation: dict[str, Any], site: int) -> NDArray[np.float64]:
    seen = float(observation["step"])
    return np.column_stack([seen + np.arange(HORIZON), np.full(HORIZON, float(site)), np.full(HORIZON, seen)])


def act_roughly(observation: dict[str, Any]) -> dict[str, Any]:
    """Onboard: slower, and not as good."""
    if observation.get("onboard") == "fails":
        raise ValueError("the onboard policy is broken")
    time.sleep(observation.get("onboard_s", 0.1))
    return {"actions": chunk(observation, 0)}


@task(
    "act",
    size=lambda _: 0.0,
    variants={"onboard": act_roughly},
    quality={"onboard": 0.5, "cloud": 1.0},
)
def act(observation: dict[str, Any]) -> dict[str, Any]:
    time.sleep(observation.get("cloud_s", 0.03))
    bad = BAD.get(observation.get("cloud", ""))
    return {"actions": chunk(observation, 1) if bad is None else bad}
