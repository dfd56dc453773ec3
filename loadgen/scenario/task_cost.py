"""What the tasks of a run cost by the objective of its scenario, from what each task took.

What a robot expects before a task is in `robot_client/policies/objectives`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from offboard.loadgen.robot_files import Late
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_two_figures import known_mean, known_quantile
from offboard.robot_client.policies.objectives import S_PER_QUALITY, Energy
from offboard.robot_client.sites.runner import ONBOARD

P95 = 95  # percent, as the objective `p95`


@dataclass(frozen=True, slots=True)
class Spent:
    """What all runs of a task took: CPU seconds onboard, and bytes sent and received.

    `remote_s`: how long the task waited for servers.
    """

    compute_s: float = 0.0
    remote_s: float = 0.0
    bytes: float = 0.0


@dataclass(frozen=True, slots=True)
class Costing:
    """The price of tasks: an objective by name, and its settings as in `[robot]` and `[workload]`."""

    objective: str = "mean"
    deadline_s: float | None = None
    s_per_joule: float = 0.0
    s_per_megabyte: float = 0.0
    energy: Energy = Energy()

    def of_task(
        self, response_s: float, quality: float | None, spent: Spent, *, failed: bool = False
    ) -> float:
        """What one task counts: seconds, or for `deadline` the quality that was lost."""
        lost = 0.0 if quality is None else 1.0 - quality
        if self.objective == "deadline":
            assert self.deadline_s is not None, "checked when the scenario was read"
            return 1.0 if failed or response_s > self.deadline_s else lost
        joules = self.energy.onboard_j(spent.compute_s) + self.energy.remote_j(spent.remote_s, spent.bytes)
        worth_s = self.s_per_joule * joules + self.s_per_megabyte * 1e-6 * spent.bytes
        return response_s + S_PER_QUALITY * lost + worth_s

    def over(self, costs: Column) -> Column:
        """The cost of the tasks in the last axis together: their mean, or their P95. NaN are left out."""
        return known_quantile(costs, P95) if self.objective == "p95" else known_mean(costs)


def spent_of(record: Mapping[str, Any], late: Late) -> Spent:
    """What the executions of a record took; a run that was still going on counts with its end."""
    compute_s, remote_s, moved = 0.0, 0.0, 0.0
    for one in record["executions"]:
        ended = late.get((record["id"], one["site"]), one)
        if one["site"] == ONBOARD:
            compute_s += _onboard_s(ended, record["features"].get(f"{ONBOARD}.capacity", 1.0))
        else:
            remote_s += one["seconds"]
            moved += ended["bytes_out"] + ended["bytes_in"]
    return Spent(compute_s, min(remote_s, record["waited_s"]), moved)


def _onboard_s(execution: Mapping[str, Any], capacity: float) -> float:
    """CPU seconds; those of a cancelled run are not known, and it counts with all that it may have had."""
    if not execution["started"]:
        return 0.0
    cpu_s = execution["cpu_s"]
    ran_s = execution["seconds"] - (execution["queue_s"] or 0.0)
    return float(capacity * ran_s if cpu_s is None else cpu_s)
