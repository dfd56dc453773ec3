"""How many scenarios and faults are played: some in `make test-all`, all in `make chaos` (CHAOS=1)."""

import os

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.robot.work import make_work
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped

ALL = os.environ.get("CHAOS") == "1"
SCENARIOS = [name for name in shipped() if read_scenario(find_scenario(name)).checks]
SHORT = [name for name in SCENARIOS if name != "soak"]
FAULT_TIMES = {"local": 20, "docker": 3} if ALL else {"local": 1, "docker": 1}
FEW_FAULTS = {
    "local": ("truncation", "relay killed", "robot killed"),
    "docker": (),  # tests/compose already cuts networks and kills parts
}
WRONG = SHORT if ALL else ["calm"]  # scenarios that are played with policies that must fail
BROKEN = ["dead-robot", "lying-cloud"] if ALL else ["dead-robot"]  # broken parts that are played
IN_CONTAINERS = SHORT if ALL else ["cloud-busy"]
ON_LOOPBACK = SHORT if ALL else []  # WRONG and HELD already play some there
# Short ones: a dead spot, stalls, load, a slow link, an objective, several servers.
HELD = ["outage", "heavy-tail", "robot-busy", "bandwidth", "deadline", "cloud-restart"]
SOAK_TASKS = 400  # 20 seconds
LEAK_TASKS = 600


def skip_if_unplayable(scenario: Scenario) -> None:
    """Skip a scenario with inputs if the library of its task is missing here, where answers are verified."""
    if scenario.workload.inputs is None:
        return
    try:
        make_work(scenario.workload.robot(scenario.seed))
    except ConfigError as error:
        pytest.skip(f"{scenario.name}: {error}")
