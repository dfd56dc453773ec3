"""The settings of `loadgen fleet`, and the size of one fleet."""

import math
from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen.table.table_columns import ColumnSettings
from offboard.loadgen.table.table_formats import Heading
from offboard.robot_client import policies
from offboard.robot_client.sites.runner import CLOUD

HEADINGS = {
    "robots": Heading("robots", "robots", 0),
    "servers": Heading("servers", "servers", 0),
    "workers": Heading("workers", "workers", 0),
    "mean_ms": Heading("mean ms", "mean ms", 1),
    "p99_ms": Heading("P99 ms", "P99 ms", 0),
    "regret_ms": Heading("regret ms", "regret ms", 1),
    "settled_ms": Heading("settled ms", "settled ms", 1),
    "busiest": Heading("busiest", "busiest", 2),
    "idlest": Heading("idlest", "idlest", 2),
    "uneven": Heading("uneven", "uneven", 2),
    "repeats": Heading("repeats", "repeats", 2),
    "onboard_percent": Heading("onboard %", r"onboard \%", 1),
    "probe_percent": Heading("probes %", r"probes \%", 1),
}
ROBOTS_MAX, SERVERS_MAX, TASKS_MAX = 100_000, 1_000, 100_000
FLEET, TASKS = "fleet", "tasks"


@dataclass(frozen=True)
class FleetConfig(ColumnSettings):
    """Which fleets are simulated."""

    robots: tuple[int, ...] = setting(
        (10, 100, 1000), "number of robots; several numbers simulate several fleets", group=FLEET,
        minimum=1, maximum=ROBOTS_MAX, metavar="K,..",
    )  # fmt: skip
    servers: tuple[int, ...] = setting(
        (), "number of servers of each fleet (default: one for 100 robots, and at least four)", group=FLEET,
        minimum=1, maximum=SERVERS_MAX, metavar="S,..",
    )  # fmt: skip
    known: int = setting(4, "servers that each robot uses at a time", group=FLEET, minimum=2)
    workers_per_robot: float = setting(
        0.4, "size of the fleet's servers, in workers for each robot", group=FLEET, rare=True, minimum=0.001
    )
    start_s: float = setting(
        10.0, "robots start spread over this time, in seconds; 0: all at once", group=FLEET, minimum=0.0
    )
    tasks: int = setting(100, "tasks of each robot", group=TASKS, minimum=1, maximum=TASKS_MAX)
    load: float = setting(
        0.7,
        "share of the servers' time that the tasks need, if all run there",
        group=TASKS,
        minimum=0.01,
        maximum=1000.0,
    )
    rounds: float = setting(
        200_000, "mean input size: rounds of PBKDF2, 48 ms for 200,000", group=TASKS, rare=True, minimum=1
    )
    delay_ms: float = setting(
        10.0, "delay of the link, in each direction", group=TASKS, rare=True, minimum=1.0, maximum=1000.0
    )
    robot_cpus: float = setting(
        0.2, "CPU quota of each robot", group=TASKS, rare=True, minimum=0.05, maximum=64.0
    )
    timeout_s: float = setting(
        2.0, "longest wait for a server", group=TASKS, rare=True, name="timeout", minimum=0.001
    )
    policy: str = setting(policies.ALIAS, f"policy of the robots: {policies.HELP}", metavar="NAME")
    heartbeats: bool | None = setting(None, "whether robots send heartbeats, if not as the policy needs it")
    seed: int = setting(1, "random seed", minimum=0)
    jobs: int | None = setting(None, "number of processes (default: one for each CPU)", minimum=1, maximum=64)
    out: Path = setting(Path("out/fleet"), "folder for fleet.json and fleet.png", metavar="DIR")

    def __post_init__(self) -> None:
        check(self)
        policies.check_name(self.policy, "--policy")
        if self.policy.rpartition(":")[2] == CLOUD:
            raise ConfigError(f"--policy: {self.policy!r} needs a server named {CLOUD}; a fleet has none")
        self.check_columns(HEADINGS)
        if self.servers and len(self.servers) not in (1, len(self.robots)):
            raise ConfigError(
                f"--servers: {len(self.servers)} numbers for {len(self.robots)} of --robots; "
                "give one, or one for each"
            )

    def fleets(self) -> list["FleetSize"]:
        servers = self.servers or tuple(max(4, math.ceil(robots / 100)) for robots in self.robots)
        if len(servers) == 1:
            servers *= len(self.robots)
        return [
            FleetSize(robots, count, max(1, round(self.workers_per_robot * robots / count)))
            for robots, count in zip(self.robots, servers, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class FleetSize:
    """How many robots and servers there are, and how many tasks each server runs at once."""

    robots: int
    servers: int
    workers: int

    def period_s(self, task_s: float, load: float) -> float:
        """The mean time between two tasks of a robot, if they shall take this share of all workers."""
        return task_s * self.robots / (load * self.servers * self.workers)
