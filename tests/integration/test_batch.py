"""`Offloader.map` with real processes: a robot and a cloud of the same speed, and a link between them."""

import json
import statistics
import sys
from pathlib import Path

import pytest

from offboard.loadgen.testbed.local_testbed import COMMANDS, LocalTestbed
from offboard.loadgen.testbed.testbed import Setup

pytestmark = [pytest.mark.integration, pytest.mark.timeout(150)]

CPUS = 0.3  # for robot and cloud each: together they need less than one core
DELAY_MS = 5.0
REPEATS = 3  # of each way, in turns
FASTER = 1.5
ATTEMPTS = 2  # other programs on the machine may slow down two busy parts more than one
RUN_S = 60.0
SETUPS = {
    "cloud": Setup({"tasks": "offboard.loadgen.scenario.hash_tasks", "workers": 2}, CPUS),
    "wan": Setup({"delay_ms": DELAY_MS}),
    "robot": Setup({"repeats": REPEATS}, CPUS),
}
ROBOT = {**COMMANDS, "robot": (sys.executable, "-m", "tests.batch_robot")}


def measure(out: Path) -> dict[str, float]:
    """The median seconds of a batch onboard, in the cloud, and on all sites."""
    with LocalTestbed(out, SETUPS, commands=ROBOT) as bed:
        bed.start()
        bed.start("robot")
        assert bed.wait("robot", RUN_S) == 0, bed.children["robot"].tail()
    lines = [json.loads(line) for line in (out / "logs" / "robot.log").read_text().splitlines()]
    for line in lines:
        assert line["where"] != "all" or min(line["onboard"], line["cloud"]) > 0, line
    return {
        way: statistics.median(line["seconds"] for line in lines if line["where"] == way)
        for way in ("onboard", "cloud", "all")
    }


def test_a_batch_on_both_sites_ends_sooner_than_on_the_better_one(tmp_path: Path) -> None:
    """40 tasks of mixed sizes on two sites with 0.3 CPU each end 1.5 times sooner; twice would be perfect."""
    found = []
    for attempt in range(ATTEMPTS):
        seconds = measure(tmp_path / str(attempt))
        found.append(min(seconds["onboard"], seconds["cloud"]) / seconds["all"])
        print(f"{found[-1]:.2f} times sooner: {seconds}")
        if found[-1] >= FASTER:
            break
    assert max(found) >= FASTER, f"{found}, at least {FASTER} expected"
