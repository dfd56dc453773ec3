"""Plays a scenario on the local testbed: starts the parts, drives the robot, prints and keeps the table."""

from collections.abc import Sequence
from pathlib import Path

from common.errors import ConfigError, OffloadError
from loadgen.disturbance import WAYS
from loadgen.evaluate import TableConfig, table_text
from loadgen.scenario import Scenario, find_scenario, read_scenario
from loadgen.testbed import LocalTestbed
from robot_client.trace import alone_path

TRACE = "trace.jsonl"
TABLE = "table.md"
DEMO_WINDOWS = ("5", "10", "20", "30", "40", "50")
ROBOT_S_A_TASK = 10.0  # a run that takes longer than this for each of its tasks has hung
ROBOT_S_AT_LEAST = 300.0


def play(scenario: Scenario, out: Path) -> int:
    """Play to the end; the robot's exit code. The trace is OUT/trace.jsonl, an earlier one is replaced.

    Where the workload asks for it, the plans measured alone are in OUT/trace.alone.jsonl.
    """
    trace = make_room(out)
    quota = f"{scenario.robot.cpus:g} CPU"
    with LocalTestbed(
        out,
        link={**scenario.link, "seed": scenario.seed},
        cloud_args=cloud_args(scenario),
        robot_cpus=scenario.robot.cpus,
    ) as testbed:
        print(f"starting the cloud server and the relay (logs in {out / 'logs'})", flush=True)
        testbed.start()
        print(f"starting the robot, held to {quota}: {scenario.workload.tasks} plans", flush=True)
        testbed.start_robot(robot_args(scenario, scenario.workload.map, trace))
        held = testbed.quota("robot")
        if held is not None:
            print(f"quota: {held.cpus:g} CPU over {held.period_s * 1e3:g} ms by {held.kind}", flush=True)
        tasks = scenario.workload.tasks + len(WAYS) * scenario.workload.alone
        code = testbed.wait("robot", max(ROBOT_S_AT_LEAST, ROBOT_S_A_TASK * tasks))
    if code < 0:
        raise OffloadError(f"the robot was ended by signal {-code}")
    print(f"written: {trace}", flush=True)
    if scenario.workload.alone:
        print(f"written: {alone_path(trace)}", flush=True)
    return code


def play_demo(out: Path) -> int:
    """The shipped demo scenario, then Table II of the plans that were measured on both sites."""
    code = play(read_scenario(find_scenario("demo")), out)
    if code != 0:
        raise OffloadError(f"the robot ended with exit code {code}")
    text = table_text(out / TRACE, TableConfig(windows=DEMO_WINDOWS, feedback="both"))
    (out / TABLE).write_text(text)
    print(f"\n{text}\nwritten: {out / TABLE}; charts: loadgen report {out}")
    return 0


def make_room(out: Path) -> Path:
    """The trace to be written in `out`, which is made; what an earlier run left there is removed."""
    trace = out / TRACE
    try:
        out.mkdir(parents=True, exist_ok=True)
        for left in (trace, alone_path(trace)):
            left.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written to: {error.strerror}") from error
    return trace


def cloud_args(scenario: Scenario) -> Sequence[str]:
    """Flags of `cloud-server`, but for where it listens."""
    return ["--executor", scenario.cloud.executor, "--workers", str(scenario.cloud.workers)]


def robot_args(scenario: Scenario, map: Path, trace: Path) -> Sequence[str]:
    """Flags of `robot-client`, but for where the cloud is; the map and the trace as the robot sees them."""
    workload, robot = scenario.workload, scenario.robot
    flags = {
        "map": map,
        "resolution": workload.resolution,
        "tasks": workload.tasks,
        "measure": workload.measure,
        "alone": workload.alone,
        "obstacles": workload.obstacles,
        "radius": workload.radius_m,
        "policy": robot.policy,
        "predictor": robot.predictor,
        "window": robot.window,
        "timeout": robot.timeout_s,
        "seed": scenario.seed,
        "trace": trace,
    }
    return [part for flag, value in flags.items() for part in (f"--{flag}", str(value))]
