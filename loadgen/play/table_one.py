"""Table I of a dataset: what the robot and the cloud ran on, as in the paper.

`machine` finds out what this machine is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from offboard.loadgen.play.machine import system_in
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.table.table_formats import Heading, Table
from offboard.loadgen.testbed.container_part import service_of
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT

HEADINGS = {
    "what": Heading("", "", None),
    "robot": Heading("robot", "robot", None),
    "cloud": Heading("cloud", "cloud", None),
}


@dataclass(frozen=True, slots=True)
class Specification:
    """One line: the same thing of both parts."""

    what: str
    robot: str
    cloud: str
    note: ClassVar[str] = ""


def table_one(name: str, lines: Sequence[Specification]) -> Table:
    """Table I of the dataset with this name."""
    return Table(f"Table I of {name}: robot and cloud.", {"dataset": name}, HEADINGS, lines)


def specifications(machine: Mapping[str, Any], scenario: Scenario, run: Path) -> list[Specification]:
    """The lines. Both parts are on this machine: processes, or containers if it names a version of Docker."""
    cloud = next(server for server in scenario.servers if server.name == CLOUD)
    docker = machine.get("docker")
    inside = [machine, machine]
    if docker is not None:
        parts = setups(scenario, run)
        inside = [system_in(service_of(part, parts[part])) for part in (ROBOT, CLOUD)]
    runs_in = "a process" if docker is None else f"a container of Docker {docker}"
    cores, memory = f"{machine['cores']}, shared", f"{machine['memory_gib']:g} GiB, shared"
    quotas = f"{scenario.robot.cpus:g} CPU", f"{cloud.cpus:g} CPU"
    systems, pythons = ([str(one[key] or "unknown") for one in inside] for key in ("system", "python"))
    return [
        Specification("processor", machine["cpu"], machine["cpu"]),
        Specification("cores", cores, cores),
        Specification("CPU quota", *quotas),
        Specification("RAM", memory, memory),
        Specification("GPU", machine["gpu"], machine["gpu"]),
        Specification("runs in", runs_in, runs_in),
        Specification("system", *systems),
        Specification("kernel", machine["kernel"], machine["kernel"]),
        Specification("Python", *pythons),
    ]
