"""The simulated testbed: the computers and links of a scenario, and what its events do to them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
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
from offboard.loadgen.simulation.model.task_costs import COSTS, DECIDING_CPU_S, Noise, RobotTasks
from offboard.loadgen.simulation.model.true_costs import Oracle, TrueCosts
from offboard.loadgen.simulation.other_robots import OtherRobot
from offboard.loadgen.simulation.simulated_cloud import SimulatedCloud
from offboard.loadgen.simulation.virtual_site import SimulatedOnboard
from offboard.loadgen.testbed.testbed import ROBOT, WAN, kind_of, servers_behind
from offboard.robot_client.sites.runner import ONBOARD
from offboard.testing.virtual_clock import VirtualClock

ENDS = ("reset_after_ms", "truncate_bytes", "slow_close_ms")  # conditions of connections, not of messages
FIRST_ROBOT_EVENTS = ("cpus", "hogs", "cut", "join")  # that the robot whose policy is tested can have


class SimulatedTestbed:
    """The computers and links of one simulated run.

    - `tasks`: the tasks of every robot, by its name.
    - `heartbeat_s`: time between heartbeats of the first robot; 0 means none.
    - `begins_s`: when the first task is due, and the recordings of links begin.
    """

    def __init__(
        self,
        scenario: Scenario,
        tasks: Mapping[str, RobotTasks],
        clock: VirtualClock,
        *,
        heartbeat_s: float,
        begins_s: float = 0.0,
        noise: float = 1.0,
    ) -> None:
        seed, cpus = scenario.seed, scenario.robot.cpus
        streams = scenario.workload.streams  # their policies run on accelerators of their own
        noise = 0.0 if streams else noise  # it is in what they are shown
        self._links = {
            name: LinkFlags(**link).link.begun(begins_s) for name, link in scenario.links().items()
        }
        self._servers = {
            part.name: SimulatedServer(clock, replace(part, cpus=float(part.workers)) if streams else part)
            for part in scenario.servers
        }
        self._cpu = SimulatedCpu(clock, cpus)
        self.costs = TrueCosts(tasks[ROBOT], Noise(seed, noise))
        accelerator = SimulatedCpu(clock, 1.0) if streams else self._cpu
        self.onboard = SimulatedOnboard(clock, accelerator, self.costs)
        self.clouds: dict[str, SimulatedCloud] = {}
        self._oracle = Oracle(clock, self._cpu, self.costs, ROBOT)
        for n, part in enumerate(scenario.servers):
            self.clouds[part.name] = SimulatedCloud(
                clock,
                self._servers[part.name],
                self._cpu,
                self.costs,
                site=part.site,
                link=self._links[part.name],
                seed=seed + n * ROBOT_SEED_STEP,
                heartbeat_s=heartbeat_s,
            )
        self._others: dict[str, OtherRobot] = {}
        for n, name in enumerate(scenario.robots()[1:], 1):
            own_seed = seed + n * ROBOT_SEED_STEP
            costs = TrueCosts(tasks[name], Noise(own_seed, noise))
            self._others[name] = OtherRobot(
                clock,
                self._servers,
                costs,
                self._links,
                name=name,
                cpus=cpus,
                seed=own_seed,
                timeout_s=scenario.robot.timeout_s,
            )
        self._absent = absent_at_first(scenario.timeline())
        for name in self._absent & self._servers.keys():
            self._servers[name].kill()

    def begin(self) -> None:
        """Let the other robots start their first tasks."""
        for name, other in self._others.items():
            if name not in self._absent:
                other.start()

    @property
    def deciding_s(self) -> float:
        """The time that the first robot needs now to predict, decide, learn and record one task."""
        return DECIDING_CPU_S / self._cpu.share_of_one_more

    def foresee(self, number: int) -> Mapping[str, float]:
        """The seconds that each site alone would take for a task that starts now.

        They are infinite for a site that would never answer; a site without a connection is left out.
        """
        found = {ONBOARD: self._oracle.onboard_s(number)}
        for name, cloud in self.clouds.items():
            if cloud.connection.up:
                coming = [
                    one for other in self._others.values() if (one := other.coming_to(name)) is not None
                ]
                found[cloud.site] = self._oracle.cloud_s(number, cloud.connection, coming=coming)
        return found

    def happen(self, event: Event) -> None:
        match event.action:
            case "link":
                self._set_link(event.value, self._changed(event))
            case "cut" | "join":  # as on loopback, where all traffic passes the relays
                self._set_link({"outage": event.action == "cut"}, servers_behind(event.value, self._links))
            case "reset":
                for name in self._changed(event):
                    for connection in self._connections(name):
                        connection.lose()
            case "cpus" | "hogs":
                for part, value in event.value.items():
                    self._cpu_of(part).change(**{event.action: value})
            case action:
                _happen_to(self._servers.get(event.value) or self._others[event.value], action)

    def _changed(self, event: Event) -> Sequence[str]:
        """The servers whose links an event changes."""
        return tuple(self._links) if event.on is None else (event.on,)

    def _connections(self, server: str) -> list[SimulatedConnection]:
        others = (other.connections[server] for other in self._others.values())
        return [self.clouds[server].connection, *others]

    def _set_link(self, changes: Mapping[str, Any], servers: Iterable[str]) -> None:
        for name in servers:
            self._links[name] = self._links[name].changed(changes)
            for connection in self._connections(name):
                connection.change(self._links[name])

    def _cpu_of(self, part: str) -> SimulatedCpu:
        if part in self._servers:
            return self._servers[part].cpu
        return self._cpu if part == ROBOT else self._others[part].cpu


def _happen_to(part: SimulatedServer | OtherRobot, action: str) -> None:
    if action in ("kill", "stop", "restart"):
        part.kill()
    if action in ("start", "restart"):
        part.start()
    if action == "pause":
        part.pause()
    if action == "resume":
        part.resume()


def check_simulated(scenario: Scenario) -> None:
    """Raise ConfigError if the scenario has inputs, an event or a link condition that cannot be simulated."""
    prefix = f"scenario {scenario.name} cannot be simulated"
    task = scenario.workload.task
    if scenario.workload.inputs is not None and str(task).partition(":")[2] not in COSTS:
        raise ConfigError(f"{prefix}: the costs of task {task} are not known")
    links = {name: LinkFlags(**link).link for name, link in scenario.links().items()}
    for link in links.values():
        _check_link(prefix, link)
    for event in scenario.timeline():
        if event.action == "link":
            for name in links if event.on is None else [event.on]:
                links[name] = links[name].changed(event.value)
                _check_link(prefix, links[name])
        for part in event.parts():
            if kind_of(part) == WAN or (part == ROBOT and event.action not in FIRST_ROBOT_EVENTS):
                raise ConfigError(f"{prefix}: event {event.action} of {part} needs real processes")


def _check_link(prefix: str, link: Link) -> None:
    for name in ENDS:
        for conditions in (link.up, link.down):
            if value := getattr(conditions, name):
                raise ConfigError(f"{prefix}: link condition {name} = {value:g} needs real connections")
