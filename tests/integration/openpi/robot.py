"""The task of these tests, whose function is a slow small policy onboard, and the robots that call it."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from offboard.common.tasks import task
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import Execution

ONBOARD_S = 0.03
START_S = 30.0
LOOK_S = 0.005


@task("openpi_act", policy_server=True, size=lambda observation: np.size(observation["state"]))
def act(observation: dict[str, Any]) -> dict[str, Any]:
    time.sleep(ONBOARD_S)
    return {"actions": np.asarray(observation["state"], np.float32) * 2, "by": "onboard"}


@task("openpi_undeclared", size=float)
def undeclared(number: int) -> int:
    return number


def observation(number: float = 1.0, **more: Any) -> dict[str, Any]:
    image = np.full((32, 32, 3), 7, np.uint8)
    return {"state": np.array([number, -number]), "image": image, "prompt": "wave", **more}


def inputs(seed: int) -> Iterator[dict[str, Any]]:
    """Endless observations, for `loadgen call`."""
    random = np.random.default_rng(seed)
    while True:
        yield observation(random.uniform(1, 5))


def right(action: dict[str, Any], number: float) -> bool:
    """Whether this is the action for `observation(number)`, whoever answered."""
    return bool(np.array_equal(action["actions"], np.float32([2 * number, -2 * number])))


def of_gpu(offload: Offloader) -> Execution:
    """What the site `gpu` did of the last task."""
    assert offload.last is not None
    return next(one for one in offload.last.executions if one.site == "gpu")


def used(offload: Offloader) -> str | None:
    assert offload.last is not None
    return offload.last.used


def why_absent(offload: Offloader) -> str:
    """Why the site `gpu` cannot take a task now; empty if it can."""
    return offload.wait_for_sites(act, 0.0).get("gpu", "")


def until(holds: Callable[[], bool]) -> None:
    """Wait until this holds."""
    end_s = time.monotonic() + START_S
    while not holds():
        assert time.monotonic() < end_s, "it never held"
        time.sleep(LOOK_S)
