"""Scenarios: everything that defines a run, as data.

`scenario_file` reads it from TOML, `play` runs it with real processes, `simulation` in virtual time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from offboard.common.config import check, part_of, setting
from offboard.common.errors import ConfigError
from offboard.common.variants import IN_GROUP
from offboard.loadgen import rivals
from offboard.loadgen.policy_name import split_objective
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.rivals.stream_rules import RULES, STREAM
from offboard.loadgen.robot.config import (
    TASKS_DEFAULT,
    CallConfig,
    Calling,
    DriveConfig,
    Load,
    Planning,
    RobotConfig,
    Streaming,
)
from offboard.loadgen.scenario.event_timeline import AT_TASK_MAX, Event
from offboard.loadgen.scenario.outcome import Costing
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.pass_fail_check import Check, check_computable
from offboard.loadgen.scenario.random_faults import Chaos
from offboard.loadgen.testbed.cpu_quota import CPUS_MAX, CPUS_MIN
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, relay_of
from offboard.robot_client import policies
from offboard.robot_client.flags import Waits
from offboard.robot_client.policies import BOTH
from offboard.robot_client.policies.objectives import MEAN, Energy
from offboard.robot_client.settings import DecisionOptions, ObjectiveOptions, Settings
from offboard.robot_client.sites.runner import ONBOARD

ROBOTS_MAX = 64
SERVERS_MAX = 16


@dataclass(frozen=True, kw_only=True)
class Workload(Load, Planning, Calling, Streaming):
    """`[workload]`: the tasks of the robots, and when they are due.

    In a scenario file, the paths of `map` and of a file of sizes are relative to that file.
    """

    tasks: int = setting(TASKS_DEFAULT, "number of tasks of each robot", minimum=1, maximum=AT_TASK_MAX)
    robots: int = setting(1, "number of robots; each has its own CPU quota", minimum=1, maximum=ROBOTS_MAX)
    deadline_ms: float | None = setting(None, "a task that takes longer than this is late", minimum=0.0)

    def __post_init__(self) -> None:
        check(self)
        if (self.map is None) == (self.task is None):
            raise ConfigError("workload.map: give either map or task")
        if self.inputs is not None and self.task is None:
            raise ConfigError(f"workload.inputs: {self.inputs!r} needs workload.task")
        if self.measure > self.tasks:
            raise ConfigError(f"workload.measure: {self.measure} is above workload.tasks {self.tasks}")
        if self.alone > self.tasks:
            raise ConfigError(f"workload.alone: {self.alone} is above workload.tasks {self.tasks}")

    @property
    def streams(self) -> bool:
        return self.stream_hz is not None

    @property
    def deadline_s(self) -> float | None:
        return None if self.deadline_ms is None else self.deadline_ms / 1e3

    def robot_names(self) -> tuple[str, ...]:
        return tuple(ROBOT if n == 1 else f"{ROBOT}-{n}" for n in range(1, self.robots + 1))

    def robot(self, seed: int) -> RobotConfig:
        """The settings of a robot with this workload; ConfigError if they contradict each other."""
        config = CallConfig if self.map is None else DriveConfig
        return part_of(config, self, seed=seed, cloud="tcp://relay:1", trace=Path("trace.jsonl"))

    def known(self) -> dict[str, bool]:
        """The keys of `[workload]` that some figures need, and whether this workload has them."""
        return {
            "jump": self.jump or self.map is None,
            "reference": self.reference > 0,
            "deadline_ms": self.deadline_ms is not None,
            "stream": self.streams,
        }


@dataclass(frozen=True, kw_only=True)
class RobotPart(DecisionOptions, ObjectiveOptions, Waits):
    """`[robot]`: how each robot decides, and its CPU quota."""

    cpus: float = setting(0.2, "CPU quota, in CPUs", minimum=CPUS_MIN, maximum=CPUS_MAX)
    policy: str = setting(
        policies.ALIAS,
        f"policy that chooses the site: {policies.HELP}; POLICY+OBJECTIVE decides by another objective"
        " than that of the scenario",
    )
    deadline_s: float | None = None  # workload.deadline_ms says it
    memory: Path | str | None = None  # a run begins without knowledge

    def __post_init__(self) -> None:
        check(self)
        self.names()

    @property
    def decides_by(self) -> str:
        """The objective of the policy; mean for a policy that weighs no costs."""
        policy, objective = split_objective(self.policy, "robot.policy")
        own = self.objective if policy in RULES or policies.weighs_cost(policy) else MEAN
        return own if objective is None else objective

    def names(self) -> tuple[str, str | None]:
        """Policy and predictor, by the names that a robot knows."""
        policy, _ = split_objective(self.policy, "robot.policy")
        policy = policies.ALIAS if policy in RULES else policy
        if self.predictor is None:
            return policy, None
        return policy, rivals.predictor(self.predictor, "robot.predictor")


@dataclass(frozen=True)
class CloudPart:
    """`[cloud]`, or each `[[cloud]]` if there are several servers: how one runs tasks, and its CPU quota.

    `link` holds the conditions of its link that differ from those of the scenario.
    """

    name: str = setting(CLOUD, "name of the server and of its site; one server is named cloud")
    group: str | None = setting(None, "group of equal servers; what is learnt of one holds for the others")
    cpus: float = setting(1.0, "CPU quota, in CPUs", minimum=CPUS_MIN, maximum=CPUS_MAX)
    executor: str = setting("threads", "kind of workers", choices=("threads", "processes"))
    workers: int = setting(1, "number of tasks that run at the same time", minimum=1)
    link: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self)
        if not self.name.isidentifier() or self.name in (ONBOARD, BOTH, WAN, ROBOT):
            taken = f"other than {ONBOARD}, {BOTH}, {WAN} and {ROBOT}"
            raise ConfigError(f"cloud.name: {self.name!r} is not a name of letters, digits and _, {taken}")
        if self.group is not None and not self.group.isidentifier():
            raise ConfigError(f"cloud.group: {self.group!r} is not a name of letters, digits and _")
        if self.group is not None and self.name == CLOUD and self.group != CLOUD:
            raise ConfigError(
                f"cloud.group: {self.group!r}: the server {CLOUD} can only be in the group {CLOUD}"
            )

    @property
    def site(self) -> str:
        """The name of its site: NAME, or GROUP/NAME; robots know the server `cloud` by this name alone."""
        return self.name if self.group is None or self.name == CLOUD else f"{self.group}{IN_GROUP}{self.name}"


@dataclass(frozen=True)
class Scenario:
    """A whole run.

    `about` says what the scenario imitates and what it tests.
    `link` has the conditions of each link, under the flag names of `loadgen wan`; a server may add its own.
    `events` are the events of the file; `timeline` adds the random faults of `chaos`.
    """

    name: str
    seed: int
    workload: Workload
    about: str = ""
    robot: RobotPart = field(default_factory=RobotPart)
    servers: tuple[CloudPart, ...] = (CloudPart(),)
    link: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    checks: tuple[Check, ...] = ()
    chaos: Chaos | None = None

    def __post_init__(self) -> None:
        names = [server.name for server in self.servers]
        if len(names) > SERVERS_MAX:
            raise ConfigError(f"cloud: {len(names)} servers, at most {SERVERS_MAX} are allowed")
        if len(set(names)) < len(names) or CLOUD not in names:
            raise ConfigError(f"cloud.name: {', '.join(names)}: each name once, and {CLOUD} among them")
        if self.robot.decides_by == "deadline" and self.workload.deadline_s is None:
            raise ConfigError("robot.objective: 'deadline' needs workload.deadline_ms")
        judged = self.costing
        if judged.objective != "deadline":
            judged = replace(judged, deadline_s=None)
        judged.check_objective(
            lambda name: "workload.deadline_ms" if name == "deadline_s" else f"robot.{name}"
        )
        self.decided_by.make()
        if self.workload.streams and self.robot.policy not in (policies.ALIAS, *RULES):
            raise ConfigError(f"robot.policy: {self.robot.policy!r} is not one of {', '.join(RULES)}")
        if self.robot.policy in RULES and not self.workload.streams:
            raise ConfigError(f"robot.policy: {self.robot.policy!r} needs workload.stream")
        if self.chaos is not None and len(self.servers) > 1:
            raise ConfigError("chaos: random faults need a scenario with one server")

    @property
    def stream_rule(self) -> str:
        """When a stream asks whom."""
        return STREAM if self.robot.policy == policies.ALIAS else self.robot.policy

    @property
    def costing(self) -> Costing:
        """What its tasks cost by the objective of the scenario, whatever the policy makes small."""
        return part_of(Costing, self.robot, deadline_s=self.workload.deadline_s)

    @property
    def decided_by(self) -> ObjectiveOptions:
        """What the policy makes small; `summary.json` has it for a replay."""
        return part_of(ObjectiveOptions, self.costing, objective=self.robot.decides_by)

    def settings(self, seed: int) -> Settings:
        """The rare options of the offloader of a robot."""
        _, predictor = self.robot.names()
        found = self.decided_by
        return part_of(
            Settings,
            self.robot,
            predictor=predictor,
            objective=found.make(),
            energy=part_of(Energy, found),
            seed=seed,
        )

    def parts(self) -> tuple[str, ...]:
        """The names of all parts of the run: servers, relays and robots."""
        return parts_of([server.name for server in self.servers], self.workload)

    def sites(self) -> tuple[str, ...]:
        return (ONBOARD, *(server.site for server in self.servers))

    def links(self) -> dict[str, Mapping[str, Any]]:
        """The conditions of the link to each server."""
        return {server.name: {**self.link, **server.link} for server in self.servers}

    def recorded(self) -> dict[str, dict[str, Any]]:
        """The servers whose links play a recording; of each the file and its hash, by direction."""
        found = {}
        for name, flags in self.links().items():
            link = LinkFlags(**flags).link
            if link.recorded:
                shown = {way: getattr(link, way).shown()["recording"] for way in ("up", "down")}
                found[name] = {way: played for way, played in shown.items() if played is not None}
        return found

    def recorded_text(self) -> str:
        """What the links play, for people; empty if they play nothing."""
        told = {name: LinkFlags(**flags).link.told() for name, flags in self.links().items()}
        return " ".join(
            f"The link to {name} plays {text}." for name, text in told.items() if text is not None
        )

    def timeline(self) -> tuple[Event, ...]:
        """All events: those of the file, and the random faults drawn from the seed."""
        if self.chaos is None:
            return self.events
        assert self.workload.rate is not None, "checked when it was read"
        seconds = self.workload.tasks / self.workload.rate
        return self.events + self.chaos.events(self.seed, seconds, LinkFlags(**self.link).link)

    def robots(self) -> tuple[str, ...]:
        return self.workload.robot_names()

    def compared(self) -> tuple[str, ...]:
        """The robots whose times count in a comparison: the first one, and every robot that is never paused.

        A robot that an event pauses only makes load: a task during the pause takes as long as the pause.
        """
        paused = {event.value for event in self.timeline() if event.action == "pause"}
        return tuple(robot for robot in self.robots() if robot == ROBOT or robot not in paused)

    def changed(
        self,
        *,
        seed: int | None = None,
        tasks: int | None = None,
        measure_all: bool = False,
        alone: int | None = None,
        reference: int | None = None,
        policy: str | None = None,
        predictor: str | None = None,
        heartbeats: bool | None = None,
    ) -> "Scenario":
        """A copy with these changes; None keeps a value.

        `measure_all` runs every task on both sites. A new `policy` brings its own predictor unless
        `predictor` is given. With `reference` 0 the checks that need reference runs are removed.
        """
        count = self.workload.tasks if tasks is None else tasks
        measure = count if measure_all else min(self.workload.measure, count)
        alone = min(self.workload.alone if alone is None else alone, count)
        workload = replace(self.workload, tasks=count, measure=measure, alone=alone)
        if reference is not None:
            workload = replace(workload, reference=reference)
        workload.robot(self.seed)
        robot = self.robot
        if policy is not None:
            robot = replace(robot, policy=policy, predictor=predictor)
        elif predictor is not None:
            robot = replace(robot, predictor=predictor)
        if heartbeats is not None:
            robot = replace(robot, heartbeats=heartbeats)
        checks = self.checks
        if reference == 0:
            checks = tuple(one for one in checks if FIGURES[one.figure].needs != "reference")
        for one in checks:
            check_computable(one, tasks=count, known=workload.known())
        return replace(
            self, seed=self.seed if seed is None else seed, workload=workload, robot=robot, checks=checks
        )


def parts_of(servers: Sequence[str], workload: Workload) -> tuple[str, ...]:
    """The names of the servers, of their relays and of the robots."""
    return (*servers, *map(relay_of, servers), *workload.robot_names())
