"""One simulated run of a scenario: the robot's own `Offloader` asks for its tasks, and what came of them."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from offboard.loadgen.scenario.interval_coverage import intervals_of, late_seconds
from offboard.loadgen.scenario.outcome import Answered, Outcome, Reference
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.timeline import Timeline
from offboard.loadgen.simulation.model.lockstep import LockstepClock
from offboard.loadgen.simulation.model.simulated_tasks import Tasks
from offboard.loadgen.simulation.world import World
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.trace import Record, as_dict
from offboard.robot_client.simulated.drive import OwnRecord
from offboard.robot_client.simulated.workload import CLOSED, due_instants
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.runner import CLOUD


@dataclass(frozen=True, slots=True)
class Foreseen(Reference):
    """What each site alone would have taken for a task, and what the robot waited for its answer."""

    waited_s: float

    @property
    def sent_s(self) -> float:
        """Hedges, probes and what was given up are in it."""
        return self.waited_s


def simulate(scenario: Scenario, tasks: Mapping[str, Tasks], *, noise: float = 1.0) -> Outcome:
    """Play it to the end; `tasks` are those of each robot. The outcome is of the first robot's."""
    run = _Run(scenario, tasks, noise)
    with run.offload:
        run.play()
    deadline_ms = scenario.workload.deadline_ms
    return Outcome(
        asked={ROBOT: scenario.workload.tasks},
        answered=run.answered(),
        references=run.references,
        deadline_s=None if deadline_ms is None else deadline_ms / 1e3,
    )


class _Run:
    """The first robot at work. Tasks that come whatever was answered have no references."""

    def __init__(self, scenario: Scenario, tasks: Mapping[str, Tasks], noise: float) -> None:
        self._noted: list[tuple[int, float, float, dict[str, Any]]] = []  # number, due, ended, trace line
        self.references: list[Reference] = []
        self._scenario = scenario
        self._clock = LockstepClock()
        self._timeline = Timeline(scenario.timeline())
        self._in_flight = 0
        self._line: deque[tuple[int, float]] = deque()  # tasks that are due, while too many are in flight
        name = predictor_of(scenario)
        plain = name.removeprefix(predictors.WORK)
        heartbeat_s = heartbeat.EVERY_S if predictors.conditional(plain) else 0.0
        self._world = World(scenario, tasks, self._clock, heartbeat_s=heartbeat_s, noise=noise)
        self._own = OwnRecord()
        robot = scenario.robot
        self.offload = Offloader(
            [self._world.cloud, self._world.onboard],
            policy=policies.make(robot.policy, scenario.seed),
            memories=Memories(
                partial(predictors.make, plain, robot.window, scenario.seed), shared_work=name != plain
            ),
            timeout_s=robot.timeout_s,
            observers=[self._own],
            clock=self._clock,
        )

    def play(self) -> None:
        for at_s in {event.at_s for event in self._timeline.left() if event.at_s is not None}:
            self._clock.at(at_s, self._look)
        self._look()
        self._world.begin()
        if self._scenario.workload.arrivals == CLOSED:
            for number in range(self._scenario.workload.tasks):
                self._ask(number, self._clock.now_s())
        else:
            self._play_open()

    def _play_open(self) -> None:
        """Each task when it is due, or as soon as fewer than allowed are in flight."""
        workload = self._scenario.workload
        assert workload.rate is not None, "checked when it was read"
        instants = due_instants(workload.arrivals, workload.rate, workload.burst, self._scenario.seed)
        for number, due_s in zip(range(workload.tasks), instants, strict=False):
            self._clock.pass_by(due_s - self._clock.now_s())
            self._line.append((number, due_s))
            self._begin()
        while self._in_flight:
            self._clock.step(math.inf)

    def _begin(self) -> None:
        while self._line and self._in_flight < self._scenario.workload.in_flight:
            number, due_s = self._line.popleft()
            self._in_flight += 1
            self._clock.begin(partial(self._ask_open, number, due_s))

    def _ask_open(self, number: int, due_s: float) -> None:
        self._ask(number, due_s)
        self._in_flight -= 1
        self._clock.at(self._clock.now_s(), self._begin)

    def _look(self) -> None:
        """Make happen what is due by now."""
        for event in self._timeline.due(self._clock.now_s(), len(self._noted)):
            self._world.happen(event)

    def _ask(self, number: int, due_s: float) -> None:
        truth, workload = self._world.truth, self._scenario.workload
        self._clock.pass_by(self._world.deciding_s)
        began_s, foreseen = self._clock.now_s(), self._world.foresee(number)
        where = BOTH if number < workload.measure else None
        self.offload(truth.function, truth.asked(number).size, number, where=where)
        record = self._own.take()
        assert record is not None, "the offloader has just told it"
        self._note(number, due_s, record)
        if workload.arrivals == CLOSED:
            self.references.append(self._reference(record, due_s, began_s - due_s, foreseen, number))
        self._look()

    def _note(self, number: int, due_s: float, record: Record) -> None:
        self._noted.append((number, due_s, self._clock.now_s(), as_dict(record)))

    def answered(self) -> list[Answered]:
        """Of all tasks, with what ended after its own."""
        late = late_seconds(line for *_, line in self._noted)
        return [
            Answered(
                i=number,
                robot=ROBOT,
                due_s=due_s,
                ended_s=ended_s,
                error=None,
                answer=None,
                chosen=line["decision"]["site"],
                both=line["decision"]["both"],
                sites=tuple(execution["site"] for execution in line["executions"]),
                intervals=intervals_of(line, late),
            )
            for number, due_s, ended_s, line in self._noted
        ]

    def _reference(
        self, record: Record, due_s: float, deciding_s: float, foreseen: Mapping[str, float], number: int
    ) -> Foreseen:
        """A cloud that would not have answered within the timeout is given up."""
        timeout_s = self._scenario.robot.timeout_s
        seconds = {site: deciding_s + one for site, one in foreseen.items()}
        given_up_s = {}
        if foreseen.get(CLOUD, 0.0) >= timeout_s:
            given_up_s[CLOUD] = deciding_s + timeout_s
            del seconds[CLOUD]
        decision, waited_s = record.decision, self._clock.now_s() - due_s
        return Foreseen(number, decision.site, decision.both, seconds, given_up_s, waited_s)


def predictor_of(scenario: Scenario) -> str:
    """That of the scenario, or the one that its policy is meant with."""
    named = scenario.robot.predictor
    return policies.predictor_of(scenario.robot.policy) if named is None else named
