"""What a site would truly take for a task that was sent there now: of oracles, not of any policy."""

from collections.abc import Iterable

from offboard.loadgen.simulation.cloud import TASK
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.processor import Processor
from offboard.loadgen.simulation.model.robot_connection import Connection
from offboard.loadgen.simulation.model.server import Server
from offboard.loadgen.simulation.model.true_costs import Truth
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

Coming = tuple[float, float]  # when a request of another robot will arrive, and its CPU seconds


def onboard_s(robot: Processor, truth: Truth, number: int) -> float:
    """On an idle robot, beside its hogs of now."""
    return truth.seconds(ONBOARD, number) / robot.share(1)


def cloud_s(
    clock: VirtualClock,
    connection: Connection,
    server: Server,
    robot: Processor,
    truth: Truth,
    number: int,
    *,
    coming: Iterable[Coming],
    without: str,
) -> float | None:
    """By link, server and queue as they are now, the queue without what robot `without` has there; None for
    never. `coming` are the requests that are on their way."""
    speed = server.processor.share(1)
    if not (connection.up and server.up and speed):
        return None
    asked, now_s = truth.asked(number), clock.now_s()
    sending_s = truth.cost.sending_s / 2 / robot.share(1)
    what = f"{TASK}1"
    arrives_s = connection.to_cloud.due_s(asked.bytes_out, what, number, now_s + sending_s)
    if arrives_s is None:
        return None
    begins_s = server.processor.begins_s(arrives_s, coming, without=without)
    ends_s = begins_s + truth.seconds(CLOUD, number) / speed
    back_s = connection.to_robot.due_s(asked.bytes_in, what, number, ends_s)
    return None if back_s is None else back_s + sending_s - now_s
