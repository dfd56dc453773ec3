"""How each part of a run is started: the flags and CPU quotas of cloud server, relay and robots.

The testbed adds the addresses and starts the parts.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from offboard.loadgen.play.run_files import LINK, PICTURE, RobotFiles
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Setup

PLANNER = "offboard.common.planning.planner"


def setups(scenario: Scenario, out: Path, *, shown: bool = True) -> dict[str, Setup]:
    """The setup of each part, with paths of this computer.

    `shown` passes the output of the first robot on to our stdout; other output goes to logs.
    """
    workload, cloud = scenario.workload, scenario.cloud
    module = workload.task.partition(":")[0] if workload.task else PLANNER
    parts = {
        CLOUD: Setup({"executor": cloud.executor, "workers": cloud.workers, "tasks": module}, cloud.cpus),
        WAN: Setup({**scenario.link, "seed": scenario.seed, "truth": out / LINK}),
    }
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
        "seed": files.seed,
        "trace": files.trace,
        "answers": files.answers,
    }
    return {name: value for name, value in flags.items() if value is not None}


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
