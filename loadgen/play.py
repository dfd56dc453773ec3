"""Plays a scenario on the local testbed: starts the parts, drives the robot, prints and keeps the table."""

from collections.abc import Sequence
from pathlib import Path

from common.errors import ConfigError, OffloadError
from loadgen.evaluate import TableConfig, table_text
from loadgen.scenario import Scenario, find_scenario, read_scenario
from loadgen.testbed import LocalTestbed

TRACE = "trace.jsonl"
TABLE = "table.md"
DEMO_WINDOWS = ("5", "10", "20", "30", "40", "50")
ROBOT_S_A_TASK = 10.0  # a run that takes longer than this for each of its tasks has hung
ROBOT_S_AT_LEAST = 300.0


def play(scenario: Scenario, out: Path) -> int:
    """Play to the end; the robot's exit code. The trace is OUT/trace.jsonl, an earlier one is replaced."""
    trace = out / TRACE
    try:
        out.mkdir(parents=True, exist_ok=True)
        trace.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written to: {error.strerror}") from error
    quota = f"{scenario.robot.cpus:g} CPU"
    with LocalTestbed(
        out,
        link={**scenario.link, "seed": scenario.seed},
        cloud_args=_cloud_args(scenario),
        robot_cpus=scenario.robot.cpus,
    ) as testbed:
        print(f"starting the cloud server and the relay (logs in {out / 'logs'})", flush=True)
        testbed.start()
        print(f"starting the robot, held to {quota}: {scenario.workload.tasks} plans", flush=True)
        testbed.start_robot(_robot_args(scenario, trace))
        held = testbed.quota("robot")
        if held is not None:
            print(f"quota: {held.cpus:g} CPU over {held.period_s * 1e3:g} ms by {held.kind}", flush=True)
        code = testbed.wait("robot", max(ROBOT_S_AT_LEAST, ROBOT_S_A_TASK * scenario.workload.tasks))
    if code < 0:
        raise OffloadError(f"the robot was ended by signal {-code}")
    print(f"written: {trace}", flush=True)
    return code


def play_demo(out: Path) -> int:
    """The shipped demo scenario, then Table II of the plans that were measured on both sites."""
    code = play(read_scenario(find_scenario("demo")), out)
    if code != 0:
        raise OffloadError(f"the robot ended with exit code {code}")
    text = table_text(out / TRACE, TableConfig(windows=DEMO_WINDOWS, feedback="both"))
    (out / TABLE).write_text(text)
    print(f"\n{text}\nwritten: {out / TABLE}")
    return 0


def _cloud_args(scenario: Scenario) -> Sequence[str]:
    return ["--executor", scenario.cloud.executor, "--workers", str(scenario.cloud.workers)]


def _robot_args(scenario: Scenario, trace: Path) -> Sequence[str]:
    workload, robot = scenario.workload, scenario.robot
    flags = {
        "map": workload.map,
        "resolution": workload.resolution,
        "tasks": workload.tasks,
        "measure": workload.measure,
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
