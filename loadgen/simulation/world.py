"""The machines of a simulated scenario, and what events do to them."""

import math
from collections.abc import Mapping
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.play.run_files import ROBOT_SEED_STEP
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.event_timeline import Event, absent_at_first
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation import oracle as foresight
from offboard.loadgen.simulation.cloud import SimulatedCloud
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import DECIDING_CPU_S, Noise
from offboard.loadgen.simulation.model.processor import Processor
from offboard.loadgen.simulation.model.robot_connection import Connection
from offboard.loadgen.simulation.model.server import Server
from offboard.loadgen.simulation.model.simulated_tasks import Tasks
from offboard.loadgen.simulation.model.true_costs import Truth
from offboard.loadgen.simulation.onboard import SimulatedOnboard
from offboard.loadgen.simulation.other_robots import OtherRobot
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN
from offboard.robot_client.sites.runner import ONBOARD

ENDS = ("reset_after_ms", "truncate_bytes", "slow_close_ms")  # conditions of connections, not of messages
OF_THE_FIRST = ("cpus", "hogs", "cut", "join")  # what can happen to the robot whose policy is looked at


class World:
    """Of one run. `tasks` are those of every robot by its name; `heartbeat_s` 0: the first one sends none."""

    def __init__(
        self,
        scenario: Scenario,
        tasks: Mapping[str, Tasks],
        clock: VirtualClock,
        *,
        heartbeat_s: float,
        noise: float = 1.0,
    ) -> None:
        seed, cpus = scenario.seed, scenario.robot.cpus
        self._clock = clock
        self._link = LinkFlags(**scenario.link).link
        self._server = Server(clock, scenario.cloud)
        self._robot = Processor(clock, cpus)
        self.truth = Truth(tasks[ROBOT], Noise(seed, noise))
        self.onboard = SimulatedOnboard(clock, self._robot, self.truth)
        self.cloud = SimulatedCloud(
            clock,
            self._server,
            self._robot,
            self.truth,
            self._link,
            seed,
            heartbeat_s,
            self.onboard.own_cpu,
        )
        self._others: dict[str, OtherRobot] = {}
        for n, name in enumerate(scenario.robots()[1:], 1):
            own = seed + n * ROBOT_SEED_STEP
            truth = Truth(tasks[name], Noise(own, noise))
            self._others[name] = OtherRobot(
                name, clock, self._server, cpus, truth, self._link, own, scenario.robot.timeout_s
            )
        self._absent = absent_at_first(scenario.timeline())
        if CLOUD in self._absent:
            self._server.kill()

    def begin(self) -> None:
        """The other robots ask for their first tasks."""
        for name, other in self._others.items():
            if name not in self._absent:
                other.begin()

    @property
    def deciding_s(self) -> float:
        """What the first robot needs now for all that it does about a task but the task."""
        return DECIDING_CPU_S / self._robot.share_of_one_more

    def foresee(self, number: int) -> Mapping[str, float]:
        """Seconds that each site alone would take for a task from now on; infinite where it never answers.

        A site that cannot take it is left out.
        """
        found = {ONBOARD: foresight.onboard_s(self._robot, self.truth, number)}
        if self.cloud.connection.up:
            coming = [other.coming for other in self._others.values() if other.coming is not None]
            seconds = foresight.cloud_s(
                self._clock, self.cloud.connection, self._server, self._robot, self.truth, number,
                coming=coming, without=ROBOT,
            )  # fmt: skip
            found[CLOUD] = math.inf if seconds is None else seconds
        return found

    def happen(self, event: Event) -> None:
        match event.action:
            case "link":
                self._set_link(event.value)
            case "cut" | "join":  # as on loopback, where every way leads through the relay
                self._set_link({"outage": event.action == "cut"})
            case "reset":
                for connection in self._connections:
                    connection.lose()
            case "cpus":
                for part, cpus in event.value.items():
                    self._processor(part).change(cpus=cpus)
            case "hogs":
                for part, count in event.value.items():
                    self._processor(part).change(hogs=count)
            case action if event.value == CLOUD:
                self._to_the_server(action)
            case action:
                self._to_another(self._others[event.value], action)

    @property
    def _connections(self) -> list[Connection]:
        return [self.cloud.connection, *(other.connection for other in self._others.values())]

    def _set_link(self, changes: Mapping[str, Any]) -> None:
        self._link = self._link.changed(changes)
        for connection in self._connections:
            connection.change(self._link)

    def _processor(self, part: str) -> Processor:
        if part == CLOUD:
            return self._server.processor
        return self._robot if part == ROBOT else self._others[part].processor

    def _to_the_server(self, action: str) -> None:
        if action in ("kill", "stop", "restart"):
            self._server.kill()
        if action in ("start", "restart"):
            self._server.start()
        if action in ("pause", "resume"):
            self._server.pause(action == "pause")

    def _to_another(self, robot: OtherRobot, action: str) -> None:
        if action in ("kill", "stop", "restart"):
            robot.end()
        if action in ("start", "restart"):
            robot.begin()
        if action in ("pause", "resume"):
            robot.pause(action == "pause")


def check_simulated(scenario: Scenario) -> None:
    """ConfigError where something of the scenario has no counterpart here."""
    said = f"scenario {scenario.name} cannot be simulated"
    link = LinkFlags(**scenario.link).link
    _check_link(said, link)
    for event in scenario.timeline():
        if event.action == "link":
            link = link.changed(event.value)
            _check_link(said, link)
        for part in event.parts():
            if part == WAN or (part == ROBOT and event.action not in OF_THE_FIRST):
                raise ConfigError(f"{said}: event {event.action} of {part} is for real processes")


def _check_link(said: str, link: Link) -> None:
    for name in ENDS:
        for conditions in (link.up, link.down):
            if value := getattr(conditions, name):
                raise ConfigError(f"{said}: link condition {name} = {value:g} is for real connections")
