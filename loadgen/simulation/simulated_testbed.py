"""The simulated testbed: the computers and links of a scenario, and what its events do to them."""

import math
from collections.abc import Mapping
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.play.run_files import ROBOT_SEED_STEP
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.event_timeline import Event, absent_at_first
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.simulation.model.simulated_connection import SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.simulated_tasks import RobotTasks
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S, Noise
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.loadgen.simulation.oracle import Oracle
from offboard.loadgen.simulation.other_robots import OtherRobot, RobotSettings
from offboard.loadgen.simulation.simulated_cloud import SimulatedCloud
from offboard.loadgen.simulation.simulated_onboard import SimulatedOnboard
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN
from offboard.robot_client.sites.runner import ONBOARD

ENDS = ("reset_after_ms", "truncate_bytes", "slow_close_ms")  # conditions of connections, not of messages
FIRST_ROBOT_EVENTS = ("cpus", "hogs", "cut", "join")  # that the robot whose policy is tested can have


class SimulatedTestbed:
    """The computers and links of one simulated run.

    - `tasks`: the tasks of every robot, by its name.
    - `heartbeat_s`: time between heartbeats of the first robot; 0 means none.
    """

    def __init__(
        self,
        scenario: Scenario,
        tasks: Mapping[str, RobotTasks],
        clock: VirtualClock,
        *,
        heartbeat_s: float,
        noise: float = 1.0,
    ) -> None:
        seed, cpus = scenario.seed, scenario.robot.cpus
        self._link = LinkFlags(**scenario.link).link
        self._server = SimulatedServer(clock, scenario.cloud)
        self._cpu = SimulatedCpu(clock, cpus)
        self.costs = TrueCosts(tasks[ROBOT], Noise(seed, noise))
        self.onboard = SimulatedOnboard(clock, self._cpu, self.costs)
        self.cloud = SimulatedCloud(
            clock,
            self._server,
            self._cpu,
            self.costs,
            link=self._link,
            seed=seed,
            heartbeat_s=heartbeat_s,
        )
        self._oracle = Oracle(
            clock=clock,
            connection=self.cloud.connection,
            server=self._server,
            robot=self._cpu,
            costs=self.costs,
            owner=ROBOT,
        )
        self._others: dict[str, OtherRobot] = {}
        for n, name in enumerate(scenario.robots()[1:], 1):
            own_seed = seed + n * ROBOT_SEED_STEP
            costs = TrueCosts(tasks[name], Noise(own_seed, noise))
            settings = RobotSettings(name, cpus, own_seed, scenario.robot.timeout_s)
            self._others[name] = OtherRobot(
                settings, clock=clock, server=self._server, costs=costs, link=self._link
            )
        self._absent = absent_at_first(scenario.timeline())
        if CLOUD in self._absent:
            self._server.kill()

    def begin(self) -> None:
        """Let the other robots start their first tasks."""
        for name, other in self._others.items():
            if name not in self._absent:
                other.begin()

    @property
    def deciding_s(self) -> float:
        """The time that the first robot needs now to predict, decide, learn and record one task."""
        return DECIDING_CPU_S / self._cpu.share_of_one_more

    def foresee(self, number: int) -> Mapping[str, float]:
        """The seconds that each site alone would take for a task that starts now.

        They are infinite for a site that would never answer; a site without a connection is left out.
        """
        found = {ONBOARD: self._oracle.onboard_s(number)}
        if self.cloud.connection.up:
            coming = [other.coming for other in self._others.values() if other.coming is not None]
            seconds = self._oracle.cloud_s(number, coming=coming)
            found[CLOUD] = math.inf if seconds is None else seconds
        return found

    def happen(self, event: Event) -> None:
        match event.action:
            case "link":
                self._set_link(event.value)
            case "cut" | "join":  # as on loopback, where all traffic passes the relay
                self._set_link({"outage": event.action == "cut"})
            case "reset":
                for connection in self._connections:
                    connection.lose()
            case "cpus":
                for part, cpus in event.value.items():
                    self._cpu_of(part).change(cpus=cpus)
            case "hogs":
                for part, count in event.value.items():
                    self._cpu_of(part).change(hogs=count)
            case action if event.value == CLOUD:
                self._happen_to_server(action)
            case action:
                self._happen_to_robot(self._others[event.value], action)

    @property
    def _connections(self) -> list[SimulatedConnection]:
        return [self.cloud.connection, *(other.connection for other in self._others.values())]

    def _set_link(self, changes: Mapping[str, Any]) -> None:
        self._link = self._link.changed(changes)
        for connection in self._connections:
            connection.change(self._link)

    def _cpu_of(self, part: str) -> SimulatedCpu:
        if part == CLOUD:
            return self._server.cpu
        return self._cpu if part == ROBOT else self._others[part].cpu

    def _happen_to_server(self, action: str) -> None:
        if action in ("kill", "stop", "restart"):
            self._server.kill()
        if action in ("start", "restart"):
            self._server.start()
        if action == "pause":
            self._server.pause()
        if action == "resume":
            self._server.resume()

    def _happen_to_robot(self, robot: OtherRobot, action: str) -> None:
        if action in ("kill", "stop", "restart"):
            robot.end()
        if action in ("start", "restart"):
            robot.begin()
        if action == "pause":
            robot.pause()
        if action == "resume":
            robot.resume()


def check_simulated(scenario: Scenario) -> None:
    """Raise ConfigError if the scenario has inputs, an event or a link condition that cannot be simulated."""
    prefix = f"scenario {scenario.name} cannot be simulated"
    if scenario.workload.inputs is not None:
        raise ConfigError(f"{prefix}: the costs of task {scenario.workload.task} are not known")
    link = LinkFlags(**scenario.link).link
    _check_link(prefix, link)
    for event in scenario.timeline():
        if event.action == "link":
            link = link.changed(event.value)
            _check_link(prefix, link)
        for part in event.parts():
            if part == WAN or (part == ROBOT and event.action not in FIRST_ROBOT_EVENTS):
                raise ConfigError(f"{prefix}: event {event.action} of {part} needs real processes")


def _check_link(prefix: str, link: Link) -> None:
    for name in ENDS:
        for conditions in (link.up, link.down):
            if value := getattr(conditions, name):
                raise ConfigError(f"{prefix}: link condition {name} = {value:g} needs real connections")
