"""How each part of a run is started: the flags and CPU quotas of servers, relays and robots.

The testbed adds the addresses and starts the parts.
"""

from dataclasses import fields
from pathlib import Path
from typing import Any

from offboard.common.config import flag_of, settings_of
from offboard.loadgen.play.run_files import PICTURE, ROBOT_SEED_STEP, RobotFiles, link_file
from offboard.loadgen.robot.config import CallConfig, DriveConfig
from offboard.loadgen.scenario.event_timeline import absent_at_first
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.testbed.testbed import ROBOT, Setup, relay_of
from offboard.robot_client.settings import USED_BY

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
        flags: dict[str, Any] = {"executor": cloud.executor, "workers": cloud.workers, "tasks": module}
        parts[cloud.name] = Setup(flags, cloud.cpus, site=cloud.site)
        relay, seed = relay_of(cloud.name), scenario.seed + n * ROBOT_SEED_STEP
        waits = {"recording_waits": True} if cloud.name in scenario.recorded() else {}
        parts[relay] = Setup({**links[cloud.name], **waits, "seed": seed, "truth": link_file(out, relay)})
    for files in RobotFiles.of(scenario, out):
        first = files.robot == ROBOT
        flags = _robot_flags(scenario, files, first=first)
        if shown and first and workload.map is not None:
            flags["picture"] = out / PICTURE
        parts[files.robot] = Setup(
            flags,
            scenario.robot.cpus,
            shown=shown and first,
            command="call" if workload.map is None else "drive",
        )
    return parts


def _robot_flags(scenario: Scenario, files: RobotFiles, *, first: bool) -> dict[str, Any]:
    """Flags of `loadgen drive` or `call` that differ from their defaults; only the first robot measures."""
    policy, predictor = scenario.robot.names()
    parts = (scenario.workload, scenario.robot, scenario.decided_by)
    values = {field.name: getattr(part, field.name) for part in parts for field in fields(part)}
    values |= {name: None for name, names in USED_BY.items() if values["objective"] not in names}
    values |= {"policy": policy, "predictor": predictor}
    values |= {} if first else {"alone": 0, "reference": 0}
    flags = {
        flag_of(field).replace("-", "_"): values[field.name]
        for field in settings_of(CallConfig if scenario.workload.map is None else DriveConfig)
        if field.name in values and values[field.name] != field.default
    }
    if scenario.workload.streams:
        flags["stream_rule"] = scenario.stream_rule
    if sizes := scenario.workload.sizes:
        flags["sizes"] = Path(sizes[0]) if sizes[0].endswith(".csv") else ",".join(sizes)
    if absent_at_first(scenario.timeline()) & {server.name for server in scenario.servers}:
        flags["connect"] = ABSENT_CONNECT_S  # nobody waits for a server that an event starts later
    return flags | {"seed": files.seed, "trace": files.trace, "answers": files.answers}
