"""What robots and servers of a simulated fleet send each other: plain tuples, which other processes may read.

Every message takes the delay of the link, so nothing that is sent in one window of time arrives in it.
"""

from typing import NamedTuple

ASK, CANCEL, REQUEST, BEAT = range(4)  # what robots send; at the same instant, in this order
REPLY, BEAT_REPLY = range(2)  # what servers send


class ToServer(NamedTuple):
    """A message of a robot; messages are handled in the order of their fields.

    `number` counts the tasks of the robot (ASK), its requests, or its heartbeats to this server.
    `cpu_s`: what the task takes on a server. `limit_s`: for a REQUEST, when the robot gives up; for an ASK,
    what the task would take onboard. ASK asks no server: it is how the oracle hears of a task, and of the
    servers that the robot uses (`ways`).
    """

    arrives_s: float
    sort: int
    robot: int
    server: int
    number: int
    cpu_s: float = 0.0
    limit_s: float = 0.0
    ways: tuple[int, ...] = ()


class ToRobot(NamedTuple):
    """A message of a server, with the number of what it answers, and the tasks that wait at the server."""

    arrives_s: float
    robot: int
    server: int
    sort: int
    number: int
    queue: int
    queue_s: float = 0.0
    run_s: float = 0.0
