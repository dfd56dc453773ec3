"""Runs in a container: for each line on stdin one long plan onboard; prints quota and times as JSON."""

import json
import sys
import time
from pathlib import Path

from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import resampled
from offboard.common.planning.planner import Point, Pose, plan_path

SETTLE_S = 0.3  # whoever changed the quota is done with the CPU
V2, V1 = Path("/sys/fs/cgroup/cpu.max"), Path("/sys/fs/cgroup/cpu")


def quota() -> list[int]:
    """Microseconds of CPU, and of the period, that this container may take; -1 is no limit."""
    if V2.exists():
        taken, period = V2.read_text().split()
        return [-1 if taken == "max" else int(taken), int(period)]
    return [int((V1 / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period")]


grid = resampled(read_map(Path("/maps/willow-full-0.05.yaml")), 0.0125)
# Nearly every cell that can be reached is nearer than this goal.
start, goal = Pose(29.18, 3.32), Point(47.03, 40.78)
assert plan_path(grid, None, start, goal, 0.15).status == "NONE"
for _ in sys.stdin:
    time.sleep(SETTLE_S)
    began, began_cpu = time.perf_counter(), time.process_time()
    plan_path(grid, None, start, goal, 0.15)
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    print(json.dumps({"quota_us": quota(), "seconds": seconds, "cpu_s": cpu_s}), flush=True)
