"""One simulated run of a scenario: the real `Offloader` runs its tasks on a simulated testbed.

The computers and links are in `simulated_testbed.py`; several runs at once are in `simulation_pool.py`.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from offboard.loadgen.robot.run import OwnRecord
from offboard.loadgen.robot.workload import CLOSED, due_instants
from offboard.loadgen.robot_files import late_executions
from offboard.loadgen.scenario.event_timeline import Timeline
from offboard.loadgen.scenario.interval_coverage import intervals_of
from offboard.loadgen.scenario.outcome import Answered, Outcome, Reference
from offboard.loadgen.scenario.outcome_files import is_probed, spent_of
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.model.stepped_offloader import SteppedOffloader, Walk, Walker
from offboard.loadgen.simulation.model.task_costs import RobotTasks
from offboard.loadgen.simulation.simulated_stream import simulated_steps
from offboard.loadgen.simulation.simulated_testbed import SimulatedTestbed
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.runner import ONBOARD
from offboard.testing.virtual_clock import VirtualClock

HEARD_S = 1.0  # from connecting to the first task: a real robot has heard from its servers by then


@dataclass(frozen=True, slots=True)
class SimulatedReference(Reference):
    """The time that each site alone would have taken for a task, and the time that the robot waited."""

    waited_s: float

    @property
    def sent_s(self) -> float:
        """The time that the robot waited, with hedges, probes and cancelled runs."""
        return self.waited_s


def simulate(
    scenario: Scenario, tasks: Mapping[str, RobotTasks], *, noise: float = 1.0, trace: Trace | None = None
) -> Outcome:
    """Play the scenario to its end, and return the outcome of the first robot.

    `tasks` are those of each robot by name. A `noise` of 0 removes the random part of the costs. `trace` gets
    every record of the first robot.
    """
    run = _Run(scenario, tasks, noise, trace)
    with run.offload:
        run.play()
    return Outcome(
        asked={ROBOT: scenario.workload.tasks},
        answered=run.answered(),
        references=run.references,
        deadline_s=scenario.workload.deadline_s,
        costing=scenario.costing,
    )


@dataclass(frozen=True, slots=True)
class _Ended:
    """A task that has ended, with its line of the trace."""

    number: int
    due_s: float
    ended_s: float
    line: dict[str, Any]


class _Run:
    """The first robot at work.

    Only closed arrivals have references. With open arrivals several tasks run at once, and the time of one
    task depends on the others.
    """

    def __init__(
        self, scenario: Scenario, tasks: Mapping[str, RobotTasks], noise: float, trace: Trace | None
    ) -> None:
        self._ended: list[_Ended] = []
        self._steps: list[Answered] = []  # of a stream
        self.references: list[Reference] = []
        self._scenario = scenario
        self._clock = VirtualClock()
        self._timeline = Timeline(scenario.timeline())
        self._zero_s = HEARD_S if scenario.workload.arrivals == CLOSED else 0.0  # when the first task is due
        self._in_flight = 0
        self._queue: deque[tuple[int, float]] = deque()  # tasks that are due, while too many are in flight
        robot = scenario.robot
        policy, _ = robot.names()
        settings = scenario.settings(scenario.seed)
        heartbeat_s = heartbeat.EVERY_S if settings.beats(policy) else 0.0
        self._testbed = SimulatedTestbed(
            scenario, tasks, self._clock, heartbeat_s=heartbeat_s, begins_s=self._zero_s, noise=noise
        )
        self._own = OwnRecord()
        self.offload = SteppedOffloader(
            [*self._testbed.clouds.values(), self._testbed.onboard],
            policy=settings.make_policy(policy),
            memories=settings.make_memories(policy),
            allowance=settings.allowance(),
            timeout_s=robot.timeout_s,
            observers=[self._own] if trace is None else [self._own, trace.write],
            clock=self._clock,
        )

    def play(self) -> None:
        for at_s in {event.at_s for event in self._timeline.left() if event.at_s is not None}:
            self._clock.at(self._zero_s + at_s, self._play_events)
        self._play_events()
        self._testbed.begin()
        if self._scenario.workload.streams:
            self._clock.pass_by(self._zero_s)
            steps = simulated_steps(self._scenario, self.offload, self._testbed.costs, self._clock)
            for step in steps:
                self._steps.append(step)
                self._play_events()
        elif self._scenario.workload.arrivals == CLOSED:
            self._clock.pass_by(self._zero_s)
            for number in range(self._scenario.workload.tasks):
                self._offload(number, self._clock.now_s())
        else:
            self._play_open()

    def _play_open(self) -> None:
        """Start each task when it is due, or as soon as there are less than `in_flight` tasks in flight."""
        workload = self._scenario.workload
        assert workload.rate is not None, "checked when the scenario was read"
        instants = due_instants(workload.arrivals, workload.rate, workload.burst, self._scenario.seed)
        for number, due_s in zip(range(workload.tasks), instants, strict=False):
            self._clock.pass_by(due_s - self._clock.now_s())
            self._queue.append((number, due_s))
            self._begin()
        while self._in_flight:
            self._clock.step(math.inf)

    def _begin(self) -> None:
        while self._queue and self._in_flight < self._scenario.workload.in_flight:
            number, due_s = self._queue.popleft()
            self._in_flight += 1
            Walker(self._clock, self._offload_open(number, due_s)).begin()

    def _offload_open(self, number: int, due_s: float) -> Walk:
        costs = self._testbed.costs
        yield (), self._testbed.deciding_s
        record = yield from self.offload.steps(costs.function, costs.task(number).size, number)
        self._ended.append(_Ended(number, due_s, self._clock.now_s(), as_dict(record)))
        self._in_flight -= 1
        self._play_events()
        self._clock.at(self._clock.now_s(), self._begin)

    def _play_events(self) -> None:
        """Make all events happen that are due."""
        for event in self._timeline.due(
            self._clock.now_s() - self._zero_s, len(self._ended) + len(self._steps)
        ):
            self._testbed.happen(event)

    def _offload(self, number: int, due_s: float) -> None:
        """Run one of closed arrivals, with its reference."""
        costs, workload = self._testbed.costs, self._scenario.workload
        self._clock.pass_by(self._testbed.deciding_s)
        began_s, foreseen = self._clock.now_s(), self._testbed.foresee(number)
        where = BOTH if number < workload.measure else None
        self.offload(costs.function, costs.task(number).size, number, where=where)
        record = self._own.take()
        assert record is not None, "the offloader passes every record to its observers"
        ended = _Ended(number, due_s, self._clock.now_s(), as_dict(record))
        self._ended.append(ended)
        self.references.append(self._reference(record, ended, began_s - due_s, foreseen))
        self._play_events()

    def answered(self) -> list[Answered]:
        """All tasks, each with the runs that ended after the task itself."""
        if self._steps:
            return self._steps
        late = late_executions(ended.line for ended in self._ended)
        return [
            Answered(
                i=ended.number,
                robot=ROBOT,
                due_s=ended.due_s - self._zero_s,
                ended_s=ended.ended_s - self._zero_s,
                error=None,
                answer=None,
                chosen=ended.line["decision"]["site"],
                both=ended.line["decision"]["both"],
                sites=tuple(execution["site"] for execution in ended.line["executions"]),
                intervals=intervals_of(ended.line, late),
                probed=is_probed(ended.line),
                spent=spent_of(ended.line, late),
            )
            for ended in self._ended
        ]

    def _reference(
        self, record: Record, ended: _Ended, deciding_s: float, foreseen: Mapping[str, float]
    ) -> SimulatedReference:
        """The times of the sites alone. A server that would exceed the timeout counts as given up."""
        timeout_s = self._scenario.robot.timeout_s
        seconds = {site: deciding_s + site_s for site, site_s in foreseen.items()}
        late = [site for site, site_s in foreseen.items() if site != ONBOARD and site_s >= timeout_s]
        given_up_s = dict.fromkeys(late, deciding_s + timeout_s)
        for site in late:
            del seconds[site]
        decision, waited_s = record.decision, ended.ended_s - ended.due_s
        return SimulatedReference(
            i=ended.number,
            chosen=decision.site,
            both=decision.both,
            seconds=seconds,
            given_up_s=given_up_s,
            waited_s=waited_s,
        )
