"""The oracle: what each site would really take for a task that starts now. No policy knows it."""

from collections.abc import Iterable
from dataclasses import dataclass

from offboard.loadgen.simulation.model.simulated_connection import SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_direction import Message
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.loadgen.simulation.simulated_cloud import TASK
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

Coming = tuple[float, float]  # arrival time of the request of another robot, and its CPU seconds


@dataclass(frozen=True, slots=True)
class Oracle:
    """Knows the true times of the tasks of one robot, from the models of everything that they pass.

    `owner` is the name of the robot: its own requests at the server are left out of the queue.
    """

    clock: VirtualClock
    connection: SimulatedConnection
    server: SimulatedServer
    robot: SimulatedCpu
    costs: TrueCosts
    owner: str

    def onboard_s(self, number: int) -> float:
        """The time onboard, if nothing else of the robot runs."""
        return self.costs.seconds(ONBOARD, number) / self.robot.share(1)

    def cloud_s(self, number: int, *, coming: Iterable[Coming]) -> float | None:
        """The time in the cloud, if link, server and queue stay as they are now; None means no answer.

        `coming` are requests of other robots that are on their way to the server.
        """
        speed = self.server.cpu.share(1)
        if not (self.connection.up and self.server.up and speed):
            return None
        task, now_s = self.costs.task(number), self.clock.now_s()
        sending_s = self.costs.cost.sending_s / 2 / self.robot.share(1)
        request = Message(task.bytes_out, f"{TASK}1", number)
        arrives_s = self.connection.to_cloud.due_s(request, now_s + sending_s)
        if arrives_s is None:
            return None
        begins_s = self.server.cpu.begins_s(arrives_s, coming, without=self.owner)
        ends_s = begins_s + self.costs.seconds(CLOUD, number) / speed
        back_s = self.connection.to_robot.due_s(Message(task.bytes_in, f"{TASK}1", number), ends_s)
        return None if back_s is None else back_s + sending_s - now_s
