"""Runs in a container: times long plans onboard; prints the quota in force and the seconds as JSON."""

import json
import time
from pathlib import Path

from common.maps import read_map, resampled
from common.planner import Point, Pose, plan_path

PLANS = 20
V2, V1 = Path("/sys/fs/cgroup/cpu.max"), Path("/sys/fs/cgroup/cpu")


def quota() -> list[int]:
    """Microseconds of CPU, and of the period, that this container may take; -1 is no limit."""
    if V2.exists():
        taken, period = V2.read_text().split()
        return [-1 if taken == "max" else int(taken), int(period)]
    return [int((V1 / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period")]


grid = resampled(read_map(Path("/maps/willow-full-0.05.yaml")), 0.025)
# From one end of the building to the other: nearly every reachable cell is expanded.
start, goal = Pose(7.5, 10.0), Point(52.0, 38.0)
plan = plan_path(grid, None, start, goal, 0.15)
assert plan.status == "NONE", plan.status
seconds, cpu_s = [], []
for _ in range(PLANS):
    began, began_cpu = time.perf_counter(), time.process_time()
    plan_path(grid, None, start, goal, 0.15)
    seconds.append(time.perf_counter() - began)
    cpu_s.append(time.process_time() - began_cpu)
print(json.dumps({"quota_us": quota(), "seconds": seconds, "cpu_s": cpu_s, "expanded": plan.expanded}))
