"""A stream in virtual time: the real `ActionStream`, whose queue is looked at once between two steps.

Its calls are those of `SteppedOffloader`.
"""

from collections.abc import Iterator

from offboard.loadgen.robot.stream_run import StreamLoop, open_stream
from offboard.loadgen.scenario.outcome import Answered
from offboard.loadgen.scenario.outcome_files import step_of
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.model.stepped_offloader import SteppedOffloader
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.testing.virtual_clock import VirtualClock

PHASE = 0.5  # of a step, when the thread of a real stream looks: it is not tied to the loop


def simulated_steps(
    scenario: Scenario, offload: SteppedOffloader, costs: TrueCosts, clock: VirtualClock
) -> Iterator[Answered]:
    """Play the steps of the workload; each of them when its time has come."""
    workload = scenario.workload
    stream, pace = open_stream(offload, costs.function, workload, scenario.stream_rule)
    zero_s = clock.now_s()
    loop = StreamLoop(stream)
    with stream:
        for number in range(workload.tasks):
            due_s = number * pace.step_s
            clock.pass_by(zero_s + due_s - clock.now_s())
            said = loop.step((costs.task(number).size, number))
            clock.pass_by(PHASE * pace.step_s)
            stream.look()
            yield Answered(
                i=number,
                robot=ROBOT,
                due_s=due_s,
                ended_s=due_s,
                error=None,
                answer=said,
                chosen=None,
                both=False,
                sites=(),
                used=said["site"],
                quality=said["quality"],
                step=step_of(said),
            )
