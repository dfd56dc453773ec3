"""The outcome of a played scenario: its answered tasks, their cost, its reference runs and use of the parts.

`outcome_files` reads it from the folder of the run, `outcome_figures` computes figures from it.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from offboard.loadgen.scenario.interval_coverage import Interval
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_two_figures import known_mean, known_quantile
from offboard.robot_client.policies.objectives import S_PER_QUALITY
from offboard.robot_client.settings import ObjectiveOptions

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
class Step:
    """One step of a stream: whether its action was a stand-in, its age, and the change at a new chunk."""

    held: bool
    age_s: float | None
    seam: float | None


@dataclass(frozen=True, kw_only=True)
class Costing(ObjectiveOptions):
    """The price of tasks by the objective of a scenario, from what each task took.

    What a robot expects before a task is in `robot_client/policies/objectives`.
    """

    s_per_quality: float = S_PER_QUALITY

    def of_task(
        self, response_s: float, quality: float | None, spent: Spent, *, failed: bool = False
    ) -> float:
        """What one task counts: seconds, or for `deadline` the quality that was lost."""
        lost = 0.0 if quality is None else 1.0 - quality
        if self.objective == "deadline":
            assert self.deadline_s is not None, "checked when the scenario was read"
            return 1.0 if failed or response_s > self.deadline_s else lost
        joules = self.onboard_j(spent.compute_s) + self.remote_j(spent.remote_s, spent.bytes)
        worth_s = (self.s_per_joule or 0.0) * joules + (self.s_per_megabyte or 0.0) * 1e-6 * spent.bytes
        return response_s + self.s_per_quality * lost + worth_s

    def over(self, costs: Column) -> Column:
        """The cost of the tasks in the last axis together: their mean, or their P95. NaN are left out."""
        return known_quantile(costs, P95) if self.objective == "p95" else known_mean(costs)


@dataclass(frozen=True, slots=True)
class Answered:
    """One answered task; times in seconds since the first task was due.

    `chosen` is the site that the policy chose, `sites` are all sites that the task ran on.
    `used` is the site whose answer was used, and `quality` that of its variant; None if the task has none.
    `wrong` says why the answer is wrong; None if it is right or was not verified.
    `unverified` says why an answer whose bytes are not the expected ones could not be compared further.
    `intervals` are the prediction intervals of its executions.
    `server_s` is the run time that the cloud server reported, without link and queue.
    `probed` says whether a second site ran it too, so that its time is learnt.
    `overhead_s` is what Offboard itself added to the time of the task; None: unknown.
    `spent` is what all its runs took. `step` is set if the task was a step of a stream.
    """

    i: int
    robot: str
    due_s: float
    ended_s: float
    error: str | None
    answer: Any
    chosen: str | None
    both: bool
    sites: tuple[str, ...]
    wrong: str | None = None
    intervals: tuple[Interval, ...] = ()
    server_s: float | None = None
    unverified: str | None = None
    overhead_s: float | None = None
    used: str | None = None
    quality: float | None = None
    probed: bool = False
    spent: Spent = Spent()
    step: Step | None = None

    @property
    def response_s(self) -> float:
        """The time from when the task was due to its answer."""
        return self.ended_s - self.due_s

    def cost(self, costing: Costing) -> float:
        return costing.of_task(self.response_s, self.quality, self.spent, failed=self.error is not None)


@dataclass(frozen=True, slots=True)
class Reference:
    """One task that ran again on each site alone, and the site where the policy had sent it.

    `seconds` holds the times of the sites that answered, `given_up_s` those of the sites that did not.
    """

    i: int
    chosen: str
    both: bool
    seconds: Mapping[str, float]
    given_up_s: Mapping[str, float]

    @property
    def oracle_s(self) -> float:
        """The time of the faster site."""
        return min(self.seconds.values())

    @property
    def sent_s(self) -> float:
        """The time of the chosen site.

        If the chosen site did not answer: the time until it was given up, plus the time of the faster site.
        """
        if self.both:
            return self.oracle_s
        if self.chosen in self.seconds:
            return self.seconds[self.chosen]
        return self.given_up_s.get(self.chosen, 0.0) + self.oracle_s


@dataclass(frozen=True, slots=True)
class Reading:
    """The memory and the open handles of one part at one moment."""

    at_s: float
    part: str
    memory_bytes: int
    handles: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """A whole run, or a range of its tasks.

    `asked` is the number of tasks that each robot asked for.
    `outage` is the number of tasks that the first robot had answered when the link first fell silent, and
    when it was back for good. `costing` is the price of its tasks.
    """

    asked: Mapping[str, int]
    answered: Sequence[Answered]
    references: Sequence[Reference] = ()
    readings: Sequence[Reading] = ()
    deadline_s: float | None = None
    outage: tuple[int, int] | None = None
    costing: Costing = Costing()

    def costs(self) -> Sequence[float]:
        return [one.cost(self.costing) for one in self.answered]

    def between(self, first: int, last: int | None = None) -> "Outcome":
        """The tasks of each robot from number `first` up to, but without, number `last`."""
        last = max(self.asked.values(), default=0) if last is None else last
        asked = {robot: max(0, min(last, tasks) - first) for robot, tasks in self.asked.items()}
        kept = [one for one in self.answered if first <= one.i < last]
        references = [one for one in self.references if first <= one.i < last]
        return replace(self, asked=asked, answered=kept, references=references)

    def of(self, robots: Collection[str]) -> "Outcome":
        """The tasks of these robots only."""
        asked = {robot: tasks for robot, tasks in self.asked.items() if robot in robots}
        return replace(self, asked=asked, answered=[one for one in self.answered if one.robot in robots])
