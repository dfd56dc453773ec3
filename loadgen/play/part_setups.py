"""How each part of a run is started: the flags and CPU quotas of servers, relays and robots.

The testbed adds the addresses and starts the parts.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from offboard.loadgen.play.run_files import PICTURE, ROBOT_SEED_STEP, RobotFiles, link_file
from offboard.loadgen.robot.decision_settings import USED_BY
from offboard.loadgen.scenario.event_timeline import absent_at_first
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.testbed.testbed import ROBOT, Setup, relay_of
from offboard.robot_client.policies.objectives import MEAN

PLANNER = "offboard.common.planning.planner"
ABSENT_CONNECT_S = 2.0  # that a robot waits for its servers if some are not there at first


def setups(scenario: Scenario, out: Path, *, shown: bool = True) -> dict[str, Setup]:
    """The setup of each part, with paths of this computer.

    `shown` passes the output of the first robot on to our stdout; other output goes to logs.
    """
    workload, links = scenario.workload, scenario.links()
    module = workload.task.partition(":")[0] if workload.task else PLANNER
    parts = {}
    for n, cloud in enumerate(scenario.servers):
        flags = {"executor": cloud.executor, "workers": cloud.workers, "tasks": module}
        parts[cloud.name] = Setup(flags, cloud.cpus, site=cloud.site)
        relay, seed = relay_of(cloud.name), scenario.seed + n * ROBOT_SEED_STEP
        waits = {"recording_waits": True} if cloud.name in scenario.recorded() else {}
        parts[relay] = Setup({**links[cloud.name], **waits, "seed": seed, "truth": link_file(out, relay)})
    for files in RobotFiles.of(scenario, out):
        first = files.robot == ROBOT
        parts[files.robot] = Setup(
            {
                **_robot_flags(scenario, files, first=first),
                **_picture(scenario, out if shown and first else None),
            },
            scenario.robot.cpus,
            shown=shown and first,
            command="call" if workload.map is None else "drive",
        )
    return parts


def _robot_flags(scenario: Scenario, files: RobotFiles, *, first: bool) -> Mapping[str, Any]:
    """Flags of `loadgen drive` or `call`. Only the first robot runs `alone` and `reference`."""
    workload, robot = scenario.workload, scenario.robot
    policy, predictor = robot.names()
    servers = {server.name for server in scenario.servers}
    flags = {
        **(_map_flags(workload) if workload.map else {"task": workload.task, "inputs": workload.inputs}),
        "sizes": _sizes(workload.sizes),
        "tasks": workload.tasks,
        "arrivals": workload.arrivals,
        "rate": workload.rate,
        "burst": workload.burst,
        "in_flight": workload.in_flight,
        "measure": workload.measure,
        "alone": workload.alone if first else 0,
        "reference": workload.reference if first else 0,
        "policy": policy,
        "predictor": predictor,
        "heartbeats": robot.heartbeats,
        "window": robot.window,
        "timeout": robot.timeout_s,
        **_objective_flags(scenario),
        # Nobody waits for a server that an event starts later.
        "connect": ABSENT_CONNECT_S if absent_at_first(scenario.timeline()) & servers else None,
        "seed": files.seed,
        "trace": files.trace,
        "answers": files.answers,
    }
    return {name: value for name, value in flags.items() if value is not None}


def _objective_flags(scenario: Scenario) -> Mapping[str, Any]:
    """What the policy makes small; for the mean time, and for a policy that weighs no costs, no flags."""
    robot, costing, name = scenario.robot, scenario.costing(), scenario.robot.decides_by
    if name == MEAN:
        return {}
    flags: dict[str, Any] = {"objective": name}
    if name == "deadline":
        return flags | {"deadline": costing.deadline_s}
    if name in USED_BY["s_per_joule"]:
        weights = {"s_per_joule": robot.s_per_joule, "s_per_megabyte": robot.s_per_megabyte}
        watts = {"compute_watts": robot.compute_watts, "idle_watts": robot.idle_watts}
        flags |= {**weights, **watts, "radio_joules_byte": robot.radio_joules_byte}
    return flags


def _map_flags(workload: Workload) -> Mapping[str, Any]:
    return {
        "map": workload.map,
        "resolution": workload.resolution,
        "planner": workload.planner,
        "jump": workload.jump,
        "obstacles": workload.obstacles,
        "radius": workload.radius_m,
    }


def _picture(scenario: Scenario, out: Path | None) -> Mapping[str, Any]:
    """The flag for the picture of a plan; None: nobody looks at this robot."""
    return {} if out is None or scenario.workload.map is None else {"picture": out / PICTURE}


def _sizes(texts: tuple[str, ...]) -> str | Path | None:
    if not texts:
        return None
    return Path(texts[0]) if texts[0].endswith(".csv") else ",".join(texts)
