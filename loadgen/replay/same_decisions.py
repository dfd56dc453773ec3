"""Compares what a policy decides, task by task, with what the run decided."""

import math
from collections.abc import Callable, Sequence

from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.loadgen.replay.virtual_robot import VirtualRobot, by_process
from offboard.robot_client.policies import Decision, Hedge

DELAY_TOLERANCE = 0.05  # of the delay of a hedge: with less between two delays, they are the same decision


def compare(
    tasks: Sequence[RecordedTask], make: Callable[[Sequence[str]], VirtualRobot]
) -> list[tuple[RecordedTask, Decision]]:
    """Each task that a rule decided in the run, with the decision of the robot that `make` makes for sites.

    The robot follows the run, so that before each task it has learnt what the run had learnt.
    """
    found = []
    for process in by_process(tasks):
        sites = tuple(dict.fromkeys(site for task in process for site in task.sites))
        for task, decision in zip(process, make(sites).follow(process), strict=True):
            if decision is not None:
                found.append((task, decision))
    return found


def same_percent(compared: Sequence[tuple[RecordedTask, Decision]]) -> float | None:
    """The share of decisions that are those of the run; None if there are none."""
    if not compared:
        return None
    return 100 * sum(same(task.decision, decision) for task, decision in compared) / len(compared)


def same(run: Decision | None, replayed: Decision) -> bool:
    """Whether both decisions start the same sites, at the same time but for DELAY_TOLERANCE."""
    if run is None or (run.site, run.both, run.spared) != (replayed.site, replayed.both, replayed.spared):
        return False
    one, other = run.second, replayed.second
    if isinstance(one, Hedge) and isinstance(other, Hedge):
        close = math.isclose(one.after_s, other.after_s, rel_tol=DELAY_TOLERANCE)
        return close and one.site == other.site
    return one == other
