"""The robots of a fleet that one process simulates, moved on in windows of time; with several, in children.

Between two windows, the robots and the servers exchange their messages.
"""

import contextlib
import gc
import logging
import multiprocessing
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, Protocol

from offboard.common.errors import OffloadError
from offboard.loadgen.fleet.fleet_messages import ToRobot, ToServer
from offboard.loadgen.fleet.fleet_robot import Common, Done, FleetNoise, FleetRobot, server_of
from offboard.loadgen.fleet.fleet_settings import FleetConfig
from offboard.loadgen.simulation.child_processes import end_quietly, starting
from offboard.loadgen.simulation.model.simulated_tasks import RobotTasks
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock

ANSWER_S = 600.0  # longest wait for a process; a window takes milliseconds
END_S = 5.0


@dataclass(frozen=True, slots=True)
class ShardSettings:
    """What the robots of a shard need: the tasks of all, their numbers, and the number of servers."""

    config: FleetConfig
    tasks: RobotTasks
    robots: range
    servers: int
    period_s: float


class Robots(Protocol):
    """Robots that are moved on in windows: `begin` starts one, `end` waits for it."""

    def begin(self, messages: Sequence[ToRobot], until_s: float) -> None: ...

    def end(self) -> tuple[list[ToServer], int]:
        """What the robots sent, and how many tasks they have done in the window."""

    def done(self) -> dict[int, list[Done]]:
        """The tasks of each robot."""

    def close(self) -> None: ...


class Shard:
    """The robots of one process."""

    def __init__(self, settings: ShardSettings) -> None:
        logging.disable(logging.WARNING)
        # Millions of objects that live on are looked through again and again otherwise; none are in circles.
        gc.disable()
        self._clock = VirtualClock()
        self._sent: list[ToServer] = []
        self._answered = 0
        common = Common(
            settings.config,
            settings.tasks,
            noise=FleetNoise(settings.config.seed),
            listed=[server_of(number) for number in range(settings.servers)],
            period_s=settings.period_s,
        )
        self._robots = {
            number: FleetRobot(number, common, self._clock, post=self._post, answered=self._count)
            for number in settings.robots
        }
        for robot in self._robots.values():
            robot.begin()

    def begin(self, messages: Sequence[ToRobot], until_s: float) -> None:
        for message in messages:
            self._clock.at(message.arrives_s, partial(self._robots[message.robot].receive, message))
        while self._clock.step(until_s):
            pass

    def end(self) -> tuple[list[ToServer], int]:
        sent, answered = self._sent, self._answered
        self._sent, self._answered = [], 0
        return sent, answered

    def done(self) -> dict[int, list[Done]]:
        return {number: robot.done for number, robot in self._robots.items()}

    def close(self) -> None:
        logging.disable(logging.NOTSET)
        gc.enable()

    def _count(self) -> None:
        self._answered += 1

    def _post(self, message: ToServer) -> None:
        self._sent.append(message)


class ShardProcess:
    """A shard in a process of its own."""

    def __init__(self, settings: ShardSettings) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, settings), daemon=True)
        with starting():
            self._process.start()
        theirs.close()

    def begin(self, messages: Sequence[ToRobot], until_s: float) -> None:
        with contextlib.suppress(OSError):  # the process has ended: `end` says so
            self._pipe.send((messages, until_s))

    def end(self) -> tuple[list[ToServer], int]:
        found: tuple[list[ToServer], int] = self._answer()
        return found

    def done(self) -> dict[int, list[Done]]:
        self._pipe.send(None)
        found: dict[int, list[Done]] = self._answer()
        return found

    def close(self) -> None:
        self._pipe.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()

    def _answer(self) -> Any:
        with contextlib.suppress(EOFError, OSError):
            if self._pipe.poll(ANSWER_S):
                return self._pipe.recv()
        raise OffloadError(f"a process of the fleet ended, or took over {ANSWER_S:g} s for a window")


def _serve(pipe: Connection, settings: ShardSettings) -> None:
    """Move a shard on until the other side closes the pipe."""
    end_quietly()
    threading.current_thread().name = "fleet"
    shard = Shard(settings)
    while True:
        try:
            wanted = pipe.recv()
        except EOFError:
            return
        if wanted is None:
            pipe.send(shard.done())
            continue
        shard.begin(*wanted)
        pipe.send(shard.end())
