"""Goals of nav2: codes, preemption and cancel, with the real planner onboard and a deaf cloud."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from queue import Queue
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import Overtaken
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Point, Pose, plan_path
from offboard.common.tasks import Task
from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, Execution
from offboard.ros2.parameters import Parameters
from offboard.ros2.planner_server import Goal, Outcome, PlannerServer, seen_from
from offboard.ros2.topics import WARN, Diagnostics
from offboard.ros2.world import View, World
from tests.fakes import ScriptedRunner

WAIT_S = 50.0


class DeafRunner(ScriptedRunner):
    """A site that answers only a cancel, as a server behind a dead link."""

    def __init__(self) -> None:
        super().__init__(CLOUD, lambda _: Execution(CLOUD, 0.0))
        self.futures: dict[int, Future[Execution]] = {}
        self.asked = threading.Semaphore(0)  # once for each task
        self.stopped = threading.Semaphore(0)  # once for each cancel

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - never in time
        self.tasks.append(task)
        future = self.futures[task.id] = Future()
        self.asked.release()
        return future

    def cancel(self, task: Task) -> None:
        super().cancel(task)
        self.futures[task.id].set_result(Execution(CLOUD, 0.1, failure=Overtaken("cancelled"), censored=True))
        self.stopped.release()


@pytest.fixture
def cloud() -> DeafRunner:
    return DeafRunner()


@pytest.fixture
def stoppable(cloud: DeafRunner) -> Iterator[Offloader]:
    """An offloader whose cloud is deaf, pinned there by the policy of always using it."""
    made = Offloader(
        [OnboardRunner(), cloud],
        policy=policies.make("cloud"),
        memories=Settings(window=5).make_memories("cloud"),
        timeout_s=10 * WAIT_S,  # only a stop ends a goal
    )
    with made:
        yield made


@pytest.fixture
def onboard() -> Iterator[Offloader]:
    with Offloader.connect(policy="paper", timeout_s=1.0, settings=Settings(window=5)) as offload:
        yield offload


@pytest.fixture
def served() -> Iterator[Callable[..., tuple[PlannerServer, World]]]:
    """Factory: a planner server with its world."""
    made: list[PlannerServer] = []

    def factory(offload: Offloader, **given: Any) -> tuple[PlannerServer, World]:
        world = World(allow_unknown=True)
        parameters = replace(Parameters.read(lambda _, default: default), **given)
        made.append(PlannerServer(offload, world, parameters))
        return made[-1], world

    yield factory
    for server in made:
        server.close()


def room() -> GridMap:
    """A room of 4 m x 4 m with a closed box in it, at 0.1 m."""
    cells = np.zeros((40, 40), np.int8)
    cells[20:30, 20:30] = 100
    cells[22:28, 22:28] = 0
    return GridMap(cells, 0.1)


def answer(server: PlannerServer, goal: Goal) -> Outcome:
    outcomes: Queue[Outcome] = Queue()
    server.accept(goal, outcomes.put)
    return outcomes.get(timeout=WAIT_S)


def to(x: float, y: float, **options: object) -> Goal:
    return Goal(Pose(x, y, 1.0), "map", **options)  # type: ignore[arg-type]


Served = Callable[..., tuple[PlannerServer, World]]


@pytest.mark.parametrize(("goal", "status"), [
    (to(3.5, 0.5), "NONE"),
    (to(9.0, 0.5), "GOAL_OUTSIDE_MAP"),
    (to(2.5, 2.1), "GOAL_OCCUPIED"),
    (to(2.5, 2.5), "NO_VALID_PATH"),
    (to(3.5, 0.5, start=Pose(-1, 0), start_frame="map"), "START_OUTSIDE_MAP"),
    (to(3.5, 0.5, start=Pose(2.1, 2.1), start_frame="map"), "START_OCCUPIED"),
    (to(3.5, 0.5, start=Pose(1, 1), start_frame="odom"), "TF_ERROR"),
    (Goal(Pose(1, 1), "base_link"), "TF_ERROR"),
    (to(3.5, 0.5, planner="Smac"), "INVALID_PLANNER"),
    (to(float("nan"), 0.5), "UNKNOWN"),
])  # fmt: skip
def test_each_goal_ends_with_the_status_of_nav2(
    onboard: Offloader, served: Served, goal: Goal, status: str
) -> None:
    """A goal that can be reached succeeds; any other one is aborted with nav2's reason and a message."""
    server, world = served(onboard, radius_m=0.15, tolerance_m=0.0)
    world.see_map(room())
    world.see_pose(Pose(0.5, 0.5))
    outcome = answer(server, goal)
    assert outcome.status == status, outcome
    assert (outcome.ending, bool(outcome.message)) == (
        ("succeeded", False) if status == "NONE" else ("aborted", True)
    )
    assert bool(len(outcome.poses)) == (status == "NONE")


def test_a_path_is_that_of_the_planner(onboard: Offloader, served: Served) -> None:
    """The poses are the cells of `plan_path`, from the start itself to the goal itself."""
    server, world = served(onboard, radius_m=0.15)
    world.see_map(room())
    world.see_pose(Pose(0.52, 0.57))
    outcome = answer(server, to(3.51, 3.59))
    plan = plan_path(room(), None, Pose(0.52, 0.57), Point(3.51, 3.59), 0.15)
    np.testing.assert_allclose(outcome.poses[1:-1, :2], plan.metres[1:-1], atol=1e-6)
    np.testing.assert_allclose(outcome.poses[[0, -1], :2], [[0.52, 0.57], [3.51, 3.59]])
    assert outcome.poses[-1, 2] == 1.0
    assert outcome.seconds > 0


def test_before_the_map_and_the_pose_goals_are_refused(onboard: Offloader, served: Served) -> None:
    """Without a map nav2's recovery starts (TIMEOUT); without a pose the transform is missing (TF_ERROR)."""
    server, world = served(onboard)
    assert answer(server, to(1, 1)).status == "TIMEOUT"
    world.see_map(room())
    assert answer(server, to(1, 1)).status == "TF_ERROR"
    assert answer(server, to(1, 1, start=Pose(0.5, 0.5), start_frame="map")).status == "NONE"


def test_an_occupied_goal_moves_within_the_tolerance(onboard: Offloader, served: Served) -> None:
    """The path ends in the free cell that is nearest to the goal."""
    server, world = served(onboard, radius_m=0.15, tolerance_m=0.5)
    world.see_map(room())
    world.see_pose(Pose(0.5, 0.5))
    outcome = answer(server, to(2.45, 2.05))
    assert outcome.status == "NONE"
    assert np.hypot(*(outcome.poses[-1, :2] - (2.45, 2.05))) < 0.35


def test_a_new_goal_replaces_the_one_before(stoppable: Offloader, served: Served, cloud: DeafRunner) -> None:
    """The old goal is aborted at once, its run is cancelled, and the new goal is planned."""
    server, world = served(stoppable)
    world.see_map(room())
    world.see_pose(Pose(0.5, 0.5))
    first, second, third = Queue[Outcome](), Queue[Outcome](), Queue[Outcome]()
    server.accept(to(1, 1), first.put)
    assert cloud.asked.acquire(timeout=WAIT_S)
    server.accept(to(3, 1), second.put)
    last = server.accept(to(1, 3), third.put)
    for outcomes in (first, second):
        outcome = outcomes.get(timeout=WAIT_S)
        assert (outcome.ending, outcome.message) == ("aborted", "a newer goal replaced this one")
    assert cloud.stopped.acquire(timeout=WAIT_S)
    assert cloud.cancelled[0] is cloud.tasks[0]
    assert cloud.asked.acquire(timeout=WAIT_S)
    server.cancel(last)
    assert third.get(timeout=WAIT_S).ending == "canceled"
    server.cancel(last)  # too late: nothing happens


def test_a_closed_server_ends_its_goal(stoppable: Offloader, served: Served, cloud: DeafRunner) -> None:
    """No client waits for a server that has ended."""
    server, world = served(stoppable)
    world.see_map(room())
    world.see_pose(Pose(0.5, 0.5))
    outcomes: Queue[Outcome] = Queue()
    server.accept(to(1, 1), outcomes.put)
    assert cloud.asked.acquire(timeout=WAIT_S)
    server.close()
    assert outcomes.get(timeout=WAIT_S).message == "the planner server ends"


def test_a_scan_from_elsewhere_is_left_out() -> None:
    """If a plan starts where the robot is not, its scan says nothing about the way."""
    view = View(room(), pose=Pose(1, 1), scan=object())  # type: ignore[arg-type]
    assert seen_from(view, Pose(1.05, 1.0)).scan is view.scan
    assert seen_from(view, Pose(2.0, 1.0)).scan is None
    assert seen_from(View(room(), scan=view.scan), Pose(2.0, 1.0)).scan is view.scan


def test_diagnostics_tell_the_last_decision(onboard: Offloader) -> None:
    """Site, reason and times are there after a task; the share counts the tasks of each site."""
    facts = Diagnostics()
    assert facts.values() == {}
    assert facts.summary() == "no task yet"
    plan_path(room(), None, Pose(0.5, 0.5), Point(1, 1), 0.1)
    onboard(plan_path, room(), None, Pose(0.5, 0.5), Point(1, 1), 0.1)
    assert onboard.last is not None
    facts(onboard.last)
    values = facts.values()
    assert values["site"] == "onboard"
    assert values["onboard.share"] == "1.00"
    assert values["reason"] == "no other site"
    assert 0 < float(values["onboard.true_ms"]) <= float(values["waited_ms"])
    assert facts.level() != WARN
