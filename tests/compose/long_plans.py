"""Runs in a container: makes one long plan for each line on stdin, and prints quota and times as JSON."""

import json
import sys
import time
from pathlib import Path

from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import resampled
from offboard.common.planning.planner import Point, Pose, plan_path

SETTLE_S = 0.3  # until the program that changed the quota needs no more CPU
V2, V1 = Path("/sys/fs/cgroup/cpu.max"), Path("/sys/fs/cgroup/cpu")


def quota() -> list[int]:
    """The CPU quota of this container and its period, in microseconds; a quota of -1 means no limit."""
    if V2.exists():
        taken, period = V2.read_text().split()
        return [-1 if taken == "max" else int(taken), int(period)]
    return [int((V1 / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period")]


grid = resampled(read_map(Path("/maps/willow-full-0.05.yaml")), 0.0125)
# A far goal: the search visits nearly every cell that can be reached.
start, goal = Pose(29.18, 3.32), Point(47.03, 40.78)
assert plan_path(grid, None, start, goal, 0.15).status == "NONE"
for _ in sys.stdin:
    time.sleep(SETTLE_S)
    began, began_cpu = time.perf_counter(), time.process_time()
    plan_path(grid, None, start, goal, 0.15)
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    print(json.dumps({"quota_us": quota(), "seconds": seconds, "cpu_s": cpu_s}), flush=True)
