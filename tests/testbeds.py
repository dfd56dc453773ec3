"""The testbed contract, one function for each sentence; every kind of testbed must keep all of them.

They share one `Bench`, whose testbed was made with `setups`, and each leaves cloud and relay running.
"""

import contextlib
import itertools
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from offboard.common.command_line import INTERRUPTED_EXIT
from offboard.common.errors import OffloadError
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.testbed.testbed import Setup, Testbed

MAP = Path(__file__).parents[1] / "maps" / "depot.yaml"
TASKS, MEASURE = 8, 4
ENDLESS = 1_000_000
DELAY_MS = 2.0
TAIL_BYTES = 1 << 14
WAIT_S = 30.0  # for steps that take at most a second on an idle machine
SETTLE_S = 1.0
PLANS_S = 2.0
SHARES, SHARE_S = 2, 0.8
SHARE_TOLERANCE = 0.2
CALM_CPUS = 0.3


@dataclass(frozen=True)
class Bench:
    """A started testbed, and what only its own kind can measure.

    `cpu` gives the time of a reading, and the CPU seconds of a part and its hogs by then. `hogs` counts hogs.
    """

    bed: Testbed
    cpu: Callable[[str], tuple[float, float]]
    hogs: Callable[[str], int]
    started: set[str] = field(default_factory=set)


def setups(out: Path) -> dict[str, Setup]:
    """`robot` makes a few plans; `robot-2` asks the cloud forever, `robot-3` plans onboard forever."""
    common = {"map": MAP, "resolution": 0.05, "window": 2, "timeout": 0.5, "connect": 20.0}

    def robot(name: str, **flags: Any) -> Setup:
        return Setup(common | flags | {"trace": out / f"{name}.jsonl"}, command="drive")

    return {
        "cloud": Setup(cpus=1.0),
        "wan": Setup({"delay_ms": DELAY_MS, "bandwidth_mbps": 0.0}),
        "robot": robot("robot", tasks=TASKS, measure=MEASURE),
        "robot-2": robot("robot-2", tasks=ENDLESS, policy="cloud"),
        "robot-3": robot("robot-3", tasks=ENDLESS, policy="onboard"),
    }


def keep(bench: Bench, sentence: Callable[[Bench], None]) -> None:
    """Check a sentence; if it fails, leave cloud and relay running, so that the others can be checked."""
    try:
        sentence(bench)
    except BaseException:  # also a time limit or Ctrl-C: the next sentences need cloud and relay
        for part in ("wan", "cloud"):
            with contextlib.suppress(OffloadError):
                bench.bed.join(part)  # if it was cut off
            if bench.bed.exit_code(part) is None:
                bench.bed.kill(part)  # it may be paused
            bench.bed.start(part)
        raise


def the_parts_work_together(bench: Bench) -> None:
    """A robot drives and exits with 0; its trace is complete and owned by our user."""
    before, records = drive(bench)
    assert len(records) == before + TASKS
    assert (bench.bed.out / "robot.jsonl").stat().st_uid == os.getuid()
    for record in records[before : before + MEASURE]:
        assert {one["site"] for one in record["executions"] if one["ok"]} == {"onboard", "cloud"}, record


def a_part_that_has_ended_is_started_again(bench: Bench) -> None:
    """A robot that is started twice appends to its trace and to its log."""
    drive(bench)
    before, records = drive(bench)
    assert before >= TASKS
    assert len(records) == before + TASKS
    log = (bench.bed.out / "logs" / "robot.log").read_text()
    assert log.count(f"{TASKS} tasks answered") >= 2, log


def the_link_changes(bench: Bench) -> None:
    """`set_link` returns the whole link, and the round trips of the robot take the new delay."""
    robot_asks_the_cloud(bench)
    changed = bench.bed.set_link(delay_ms=30.0)
    assert changed["up"]["delay_ms"] == changed["down"]["delay_ms"] == 30.0
    assert bench.bed.link()["up"]["delay_ms"] == 30.0
    wait_until(lambda: cloud_s(newest(bench)) >= 0.060)
    bench.bed.set_link(delay_ms=DELAY_MS)
    wait_until(lambda: 0.004 <= cloud_s(newest(bench)) < 0.060)


def a_killed_cloud_is_started_again(bench: Bench) -> None:
    """The exit code is -SIGKILL; the robot plans onboard until the cloud is back, then uses it again."""
    robot_asks_the_cloud(bench)
    bench.bed.kill("cloud")
    assert bench.bed.exit_code("cloud") == -signal.SIGKILL
    wait_until(lambda: newest(bench)["used"] == "onboard")
    bench.bed.start("cloud")
    assert bench.bed.exit_code("cloud") is None
    wait_until(lambda: newest(bench)["used"] == "cloud")


def a_stopped_part_says_its_exit_code(bench: Bench) -> None:
    """A stopped cloud finishes its tasks and exits with 0; a stopped robot exits as if interrupted."""
    robot_asks_the_cloud(bench)
    bench.bed.stop("cloud")
    assert bench.bed.exit_code("cloud") == 0, tail(bench, "cloud")
    bench.bed.stop("robot-2")
    assert bench.bed.exit_code("robot-2") == INTERRUPTED_EXIT
    bench.bed.start("cloud")


def a_paused_part_hangs_until_it_is_resumed(bench: Bench) -> None:
    """The robot plans onboard while the cloud is paused, and uses the cloud again after it is resumed."""
    robot_asks_the_cloud(bench)
    bench.bed.pause("cloud")
    wait_until(lambda: newest(bench)["used"] == "onboard")
    assert bench.bed.exit_code("cloud") is None
    bench.bed.resume("cloud")
    wait_until(lambda: newest(bench)["used"] == "cloud")


def a_paused_part_can_be_killed(bench: Bench) -> None:
    """SIGKILL also ends a paused part."""
    bench.bed.pause("cloud")
    bench.bed.kill("cloud")
    assert bench.bed.exit_code("cloud") == -signal.SIGKILL
    bench.bed.start("cloud")


def cpus_are_in_force(bench: Bench) -> None:
    """A busy cloud uses its CPU quota, +-20 %, and keeps the quota when it is started again.

    The quotas are small, so that even a busy machine can provide them.
    """
    end(bench, "robot-2")
    for cpus in (0.1, 0.3):
        bench.bed.set_cpus("cloud", cpus)
        bench.bed.set_hogs("cloud", 1)
        found = share(bench, "cloud")
        assert found == pytest.approx(cpus, rel=SHARE_TOLERANCE), f"{found} of {cpus}"
    bench.bed.set_cpus("cloud", 0.3)
    bench.bed.kill("cloud")
    bench.bed.start("cloud")
    bench.bed.set_hogs("cloud", 2)
    found = share(bench, "cloud")
    assert 0.1 < found < 0.3 * (1 + SHARE_TOLERANCE), f"{found} of 0.3"
    bench.bed.set_hogs("cloud", 0)
    assert share(bench, "cloud") < 0.1, "the cloud has nothing to do"
    bench.bed.set_cpus("cloud", 1.0)


def hogs_slow_a_held_robot(bench: Bench) -> None:
    """With three hogs in its quota a robot makes less than two thirds of its plans; hogs end with it.

    Counted per CPU second of robot and hogs together, as other programs may take time from both; they also
    change which processor each of the four gets, so it need not hold at once.
    """
    start(bench, "robot-3")
    bench.bed.set_cpus("robot-3", CALM_CPUS)
    wait_until(lambda: newest(bench, "robot-3") is not None)
    alone = plans_per_cpu_s(bench, "robot-3")
    bench.bed.set_hogs("robot-3", 3)
    wait_until(lambda: bench.hogs("robot-3") == 3)
    wait_until(lambda: 0 < plans_per_cpu_s(bench, "robot-3") < 2 / 3 * alone)
    bench.bed.set_hogs("robot-3", 1)
    assert bench.hogs("robot-3") == 1
    bench.bed.kill("robot-3")
    assert bench.hogs("robot-3") == 0


def a_cut_is_silence(bench: Bench) -> None:
    """A cloud that is cut off does not answer; after `join` it answers on the same connection."""
    robot_asks_the_cloud(bench)
    before = connections(bench)
    bench.bed.cut("cloud")
    wait_until(lambda: newest(bench)["used"] == "onboard")
    silent = newest(bench)
    assert [one["error"][:12] for one in silent["executions"] if one["site"] == "cloud"] == ["CloudTimeout"]
    bench.bed.join("cloud")
    wait_until(lambda: newest(bench)["used"] == "cloud")
    assert connections(bench) == before


def a_robot_and_the_relay_can_be_cut_off(bench: Bench) -> None:
    """The robot plans onboard while it, or the relay, is cut off, and uses the cloud again afterwards."""
    for part in ("robot-2", "wan"):
        robot_asks_the_cloud(bench)
        bench.bed.cut(part)
        wait_until(lambda: newest(bench)["used"] == "onboard")
        bench.bed.join(part)
        wait_until(lambda: newest(bench)["used"] == "cloud")


def usage_counts_memory_and_handles(bench: Bench) -> None:
    """A relay uses 10 MB to 1 GB, and two more handles for each connected robot."""
    for robot in ("robot-2", "robot-3"):
        end(bench, robot)
    wait_until(lambda: bench.bed.link()["connections"] == 0)
    time.sleep(SETTLE_S)  # until the connections of our own HTTP requests are closed too
    alone = bench.bed.usage("wan")
    assert 10e6 < alone.memory_bytes < 1e9, alone
    assert 4 < alone.handles < 100, alone
    robot_asks_the_cloud(bench)
    wait_until(lambda: bench.bed.link()["connections"] == 1)
    wait_until(lambda: bench.bed.usage("wan").handles == alone.handles + 2)
    assert bench.bed.usage("cloud").memory_bytes > alone.memory_bytes, "the cloud holds numba and a map"


def a_reset_resets(bench: Bench) -> None:
    """After a reset, the robot connects again and is answered by the cloud."""
    robot_asks_the_cloud(bench)
    before = connections(bench)
    bench.bed.reset()
    wait_until(lambda: connections(bench) > before and newest(bench)["used"] == "cloud")


CONTRACT: tuple[Callable[[Bench], None], ...] = (
    the_parts_work_together,
    a_part_that_has_ended_is_started_again,
    the_link_changes,
    a_killed_cloud_is_started_again,
    a_stopped_part_says_its_exit_code,
    a_paused_part_hangs_until_it_is_resumed,
    a_paused_part_can_be_killed,
    cpus_are_in_force,
    hogs_slow_a_held_robot,
    a_cut_is_silence,
    a_robot_and_the_relay_can_be_cut_off,
    usage_counts_memory_and_handles,
    a_reset_resets,
)


def drive(bench: Bench) -> tuple[int, list[dict[str, Any]]]:
    """Let `robot` make its plans; the number of records in its trace before, and all records after."""
    trace = bench.bed.out / "robot.jsonl"
    before = len(list(read_trace(trace))) if trace.exists() else 0
    start(bench, "robot")
    wait_until(lambda: bench.bed.exit_code("robot") is not None)
    assert bench.bed.exit_code("robot") == 0
    return before, list(read_trace(trace))


def robot_asks_the_cloud(bench: Bench) -> None:
    """Start `robot-2` with a small quota, and wait until the cloud has answered one of its tasks."""
    start(bench, "robot-2")
    bench.bed.set_cpus("robot-2", CALM_CPUS)
    before = newest(bench)
    wait_until(lambda: newest(bench) not in (None, before) and newest(bench)["used"] == "cloud")


def start(bench: Bench, part: str) -> None:
    """Start a part if it is not running."""
    if part not in bench.started or bench.bed.exit_code(part) is not None:
        bench.bed.start(part)
        bench.started.add(part)


def end(bench: Bench, part: str) -> None:
    if part in bench.started:
        bench.bed.stop(part)


def newest(bench: Bench, robot: str = "robot-2") -> Any:
    """The newest whole record of a robot's trace; None if there is none yet."""
    trace = bench.bed.out / f"{robot}.jsonl"
    if not trace.exists():
        return None
    with trace.open("rb") as file:
        file.seek(max(0, trace.stat().st_size - TAIL_BYTES))
        lines = file.read().split(b"\n")[:-1]
    return json.loads(lines[-1]) if lines else None


def tail(bench: Bench, part: str) -> str:
    """The end of what a part has logged."""
    return (bench.bed.out / "logs" / f"{part}.log").read_text()[-TAIL_BYTES:]


def cloud_s(record: dict[str, Any]) -> float:
    """The time of the cloud in a record; 0 if the cloud did not answer."""
    return sum(one["seconds"] for one in record["executions"] if one["site"] == "cloud" and one["ok"])


def plans_per_cpu_s(bench: Bench, robot: str) -> float:
    """The plans that a robot makes in PLANS_S, by the CPU seconds that it and its hogs use meanwhile."""
    before, (_, used_s) = newest(bench, robot)["i"], bench.cpu(robot)
    time.sleep(PLANS_S)
    return float((newest(bench, robot)["i"] - before) / (bench.cpu(robot)[1] - used_s))


def share(bench: Bench, part: str) -> float:
    """The CPUs that a part and its hogs use: the largest of SHARES readings over SHARE_S each."""
    looks = [bench.cpu(part)]
    for _ in range(SHARES):
        time.sleep(SHARE_S)
        looks.append(bench.cpu(part))
    return max((used - used_0) / (at - at_0) for (at_0, used_0), (at, used) in itertools.pairwise(looks))


def connections(bench: Bench) -> int:
    """The number of connections that the relay has accepted so far."""
    return int(bench.bed.link()["accepted"])


def wait_until(fact: Callable[[], Any]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not fact():
        assert time.monotonic() < end_s, f"not true within {WAIT_S:g} s"
        time.sleep(0.05)
