"""A control loop that plays the actions of `chunk_tasks`, and finds each wrong or stale one."""

import time
from collections.abc import Callable
from typing import Any

from offboard import Step
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.robot_client.streams.action_stream import ActionStream

HZ = 50.0


class Loop:
    """Checks that each action is for its step, and that none is older than the one before."""

    def __init__(self, actions: ActionStream, **observation: Any) -> None:
        self._actions = actions
        self.observation = observation
        self._seen = -1.0
        self.steps: list[Step] = []

    def play(self, seconds: float, until: Callable[[Step], bool] | None = None) -> list[Step]:
        """Play for this time, or until a step is so; returns the steps."""
        played: list[Step] = []
        start_s = time.monotonic()
        while (now_s := time.monotonic()) < start_s + seconds:
            self._actions.see({"step": len(self.steps), **self.observation})
            step = self._actions.next()
            if not step.held:
                assert step.action is not None
                assert step.action[0] == len(self.steps), "stale"
                assert step.site == (CLOUD if step.action[1] else ONBOARD)
                assert step.action[2] >= self._seen, "older than the action before"
                self._seen = float(step.action[2])
            self.steps.append(step)
            played.append(step)
            if until is not None and until(step):
                return played
            time.sleep(max(0.0, len(played) / HZ + start_s - now_s))
        assert until is None, f"not seen in {seconds} s: {played[-1]}, {self._actions.counts}"
        return played


def fresh(site: str) -> Callable[[Step], bool]:
    return lambda step: not step.held and step.site == site
