"""Answers goals one at a time, as nav2's planner server does: the newest goal replaces the one before.

The paths come from the task `plan_path`; where it runs is decided by the offloader. `node` connects this to
ROS.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import OffloadError
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from offboard.common.tasks import kind_of
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.offloader import Offloader
from offboard.ros2.converters import poses_along
from offboard.ros2.parameters import Parameters
from offboard.ros2.world import View, World, nearest_free

# Statuses are nav2's error codes by name; the planner returns the others itself.
NONE, UNKNOWN, TF_ERROR, TIMEOUT = "NONE", "UNKNOWN", "TF_ERROR", "TIMEOUT"
INVALID_PLANNER, GOAL_OCCUPIED = "INVALID_PLANNER", "GOAL_OCCUPIED"
# How a goal ends.
SUCCEEDED, ABORTED, CANCELED = "succeeded", "aborted", "canceled"

MESSAGES = {
    "START_OUTSIDE_MAP": "the start is outside the map",
    "GOAL_OUTSIDE_MAP": "the goal is outside the map",
    "START_OCCUPIED": "the robot cannot stand at the start",
    GOAL_OCCUPIED: "the robot cannot stand at the goal, nor within the tolerance around it",
    "NO_VALID_PATH": "no path leads from the start to the goal",
}
CLOSE_WAIT_S = 5.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Goal:
    """Where to go, and from where: without a start, from where the robot is."""

    pose: Pose
    frame: str
    start: Pose | None = None
    start_frame: str = ""
    planner: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """How a goal ended; `poses` are rows of x, y and yaw, and `seconds` is the time since it was accepted."""

    ending: str
    status: str = NONE
    message: str = ""
    poses: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    seconds: float = 0.0


@dataclass(eq=False, slots=True)
class PendingGoal:
    """A goal that was accepted. `done` is called once, in any thread."""

    goal: Goal
    done: Callable[[Outcome], None]
    accepted_s: float
    call: CallFuture[Plan] | None = None
    stopped: bool = False
    canceled: bool = False


class PlannerServer:
    """Plans in a thread of its own. At most one goal is planned, and at most one waits."""

    def __init__(self, offload: Offloader, world: World, parameters: Parameters) -> None:
        self._offload = offload
        self._world = world
        self._parameters = parameters
        self._changed = threading.Condition()
        self._running: PendingGoal | None = None
        self._waiting: PendingGoal | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="planner", daemon=True)
        self._thread.start()

    def accept(self, goal: Goal, done: Callable[[Outcome], None]) -> PendingGoal:
        """Plan for this goal, and end the goals before it. Returns at once."""
        pending = PendingGoal(goal, done, time.perf_counter())
        with self._changed:
            replaced, self._waiting = self._waiting, pending
            self._stop(self._running)
            self._changed.notify()
        if replaced is not None:
            self._end(replaced, self._stopped(replaced))
        return pending

    def cancel(self, pending: PendingGoal) -> None:
        """End this goal, unless it has ended."""
        with self._changed:
            pending.canceled = True
            waits = self._waiting is pending
            if waits:
                self._waiting = None
            self._stop(pending)
        if waits:
            self._end(pending, self._stopped(pending))

    def close(self) -> None:
        """End all goals, and wait for the thread."""
        with self._changed:
            self._closed = True
            self._stop(self._running)
            self._changed.notify()
        self._thread.join(CLOSE_WAIT_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._running = None
                while self._waiting is None and not self._closed:
                    self._changed.wait()
                pending, self._waiting = self._waiting, None
                if pending is None:
                    return
                self._running = pending
            self._end(pending, self._answer(pending))

    def _answer(self, pending: PendingGoal) -> Outcome:
        try:
            return self._plan(pending)
        except CancelledError:
            return self._stopped(pending)
        except (OffloadError, ValueError) as error:
            return Outcome(ABORTED, UNKNOWN, str(error))
        except Exception as error:  # a goal without an answer would leave nav2 waiting
            log.exception("a goal failed; remedy: report this traceback")
            return Outcome(ABORTED, UNKNOWN, f"{type(error).__name__}: {error}")

    def _stop(self, pending: PendingGoal | None) -> None:
        """End this goal within milliseconds. Called under the lock."""
        if pending is not None:
            pending.stopped = True
            if pending.call is not None:
                pending.call.cancel()

    def _stopped(self, pending: PendingGoal) -> Outcome:
        if pending.canceled:
            return Outcome(CANCELED, message="canceled")
        why = "the planner server ends" if self._closed else "a newer goal replaced this one"
        return Outcome(ABORTED, UNKNOWN, why)

    def _end(self, pending: PendingGoal, outcome: Outcome) -> None:
        pending.done(replace(outcome, seconds=time.perf_counter() - pending.accepted_s))

    def _plan(self, pending: PendingGoal) -> Outcome:
        goal, view, given = pending.goal, self._world.view(), self._parameters
        if goal.planner and goal.planner not in given.planners:
            known = ", ".join(given.planners)
            return Outcome(ABORTED, INVALID_PLANNER, f"planner {goal.planner!r}; known: {known}")
        for frame in (goal.frame, goal.start_frame if goal.start else ""):
            if frame not in ("", given.frame):
                return Outcome(ABORTED, TF_ERROR, f"a pose in frame {frame!r}; the map is in {given.frame!r}")
        if view is None:
            return Outcome(ABORTED, TIMEOUT, "no map was published yet")
        start = goal.start or view.pose
        if start is None:
            return Outcome(ABORTED, TF_ERROR, "the pose of the robot is not known yet")
        view = seen_from(view, start)
        end = Point(goal.pose.x, goal.pose.y)
        plan = self._ask(pending, view, start, end)
        if plan.status == GOAL_OCCUPIED:
            near = nearest_free(view, end, radius_m=self._radius_m(view), tolerance_m=given.tolerance_m)
            if near is not None:
                goal = replace(goal, pose=Pose(near.x, near.y, goal.pose.yaw))
                plan = self._ask(pending, view, start, near)
        if plan.status != NONE:
            return Outcome(ABORTED, plan.status, MESSAGES.get(plan.status, plan.status))
        return Outcome(SUCCEEDED, poses=poses_along(plan.metres, start, goal.pose))

    def _ask(self, pending: PendingGoal, view: View, start: Pose, end: Point) -> Plan:
        """The answer of the planner. CancelledError if the goal is stopped."""
        with self._changed:
            if pending.stopped:
                raise CancelledError
            call = pending.call = self._offload.submit(
                plan_path,
                view.grid,
                view.scan,
                pose=start,
                goal=end,
                radius_m=self._radius_m(view),
                costs=view.costs,
            )
        return call.result()

    def _radius_m(self, view: View) -> float:
        """Costs already keep the robot away from obstacles."""
        return self._parameters.radius_m if view.costs is None else 0.0


def seen_from(view: View, start: Pose) -> View:
    """The view of a robot at `start`: a scan that was taken somewhere else is left out."""
    pose, cell = view.pose, view.grid.resolution
    elsewhere = pose is not None and max(abs(pose.x - start.x), abs(pose.y - start.y)) > cell
    return replace(view, pose=start, scan=None if elsewhere else view.scan)


def prepare(offload: Offloader, timeout_s: float) -> Sequence[str]:
    """Compile the planner onboard and wait for the servers; returns why some sites cannot plan."""
    warm = kind_of(plan_path).warm
    if warm is not None:
        warm()
    absent = offload.wait_for_sites(plan_path, timeout_s)
    return [f"{site}: {why}" for site, why in absent.items()]
