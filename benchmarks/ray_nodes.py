"""`python -m benchmarks.ray_nodes`: `--executor ray` compared with threads, and with 1 and 2 nodes.

All nodes are on this computer and share its cores with the robot. So only tasks that need no CPU show what a
second node adds.
"""

import contextlib
import os
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path

from benchmarks.measure import Table, processor
from benchmarks.servers import cloud_server
from benchmarks.tasks import nothing, wait_20_ms
from offboard.common.planning import planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import free_pairs
from offboard.common.planning.planner import Point, Pose
from offboard.common.tasks import Kind, Task, kind_of
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.sites.runner import Execution

MAP = Path(__file__).parents[1] / "maps/willow-full-0.05.yaml"
MODULES = "offboard.common.planning.planner,benchmarks.tasks"
PLANS, TASKS, IN_FLIGHT = 100, 400, 4
ROUNDS = 3
BUDGET_S = 60.0
STORE_BYTES = 200 << 20  # of each node
SEED = 1


def plans() -> list[Task]:
    """Plans between random points of a real map."""
    grid, kind = read_map(MAP), kind_of(planner.plan_path)
    pairs = free_pairs(grid, PLANS, seed=SEED, radius_m=planner.RADIUS_M)
    ends = [grid.metres(pair) for pair in pairs]
    goals = [(Pose(*map(float, start)), Point(*map(float, goal))) for start, goal in ends]
    return [Task(kind, kind.bind((grid, None, *goal), {}), 0.0) for goal in goals]


def same(kind: Kind, count: int) -> list[Task]:
    return [Task(kind, (), 0.0) for _ in range(count)]


@contextlib.contextmanager
def runner(executor: str, workers: int, address: str = "auto") -> Iterator[CloudRunner]:
    """A robot's end of the connection to a server that is warm."""
    flags = {"CLOUD_EXECUTOR": executor, "CLOUD_WORKERS": str(workers), "CLOUD_RAY_ADDRESS": address}
    with (
        cloud_server(MODULES, **flags) as server,
        contextlib.closing(CloudRunner(server.endpoint)) as made,
    ):
        while made.unavailable(kind_of(planner.plan_path)):
            time.sleep(0.01)
        rate(made, plans()[:IN_FLIGHT] * 2)
        yield made


def alone(made: CloudRunner, tasks: Sequence[Task]) -> list[float]:
    """The milliseconds of each task, one after the other."""
    return [checked(made.submit(task, BUDGET_S)).seconds * 1e3 for task in tasks]


def rate(made: CloudRunner, tasks: Sequence[Task]) -> float:
    """Tasks per second with IN_FLIGHT tasks at a time."""
    under_way: deque[Future[Execution]] = deque()
    began_s = time.perf_counter()
    for task in tasks:
        if len(under_way) == IN_FLIGHT:
            checked(under_way.popleft())
        under_way.append(made.submit(task, BUDGET_S))
    for one in under_way:
        checked(one)
    return len(tasks) / (time.perf_counter() - began_s)


def checked(future: "Future[Execution]") -> Execution:
    one = future.result()
    if one.run_s is None:
        raise RuntimeError(f"a task failed: {one.error}")
    return one


def latencies(address: str) -> Table:
    """One task after the other with threads and with one Ray node, in turn."""
    kinds = {"a plan": plans(), "an empty task": same(kind_of(nothing), PLANS)}
    found: dict[tuple[str, str], list[float]] = {}
    with runner("threads", 1) as threads, runner("ray", 1, address) as ray_node:
        for _ in range(ROUNDS):
            for name, tasks in kinds.items():
                found.setdefault((name, "threads"), []).extend(alone(threads, tasks))
                found.setdefault((name, "ray"), []).extend(alone(ray_node, tasks))
    rows = []
    for name in kinds:
        threads_ms, ray_ms = (statistics.median(found[name, executor]) for executor in ("threads", "ray"))
        rows.append([name, f"{threads_ms:.2f}", f"{ray_ms:.2f}", f"{ray_ms - threads_ms:.2f}"])
    return Table("One task after the other, median ms", ("task", "threads", "ray", "added"), rows)


def rates(address: str, add: Callable[[], object]) -> Table:
    """Tasks per second with one node, and with a second one."""
    kinds = {"plans": plans(), "waits of 20 ms": same(kind_of(wait_20_ms), TASKS)}
    kinds["empty tasks"] = same(kind_of(nothing), TASKS)
    cases = [("threads", 1), ("ray", 1), ("threads", 2), ("ray", 2)]
    rows = []
    for executor, workers in cases:
        if (executor, workers) == ("ray", 2):
            add()
        with runner(executor, workers, address) as made:
            each = [statistics.median(rate(made, tasks) for _ in range(ROUNDS)) for tasks in kinds.values()]
        rows.append([executor, str(workers), *(f"{one:.0f}" for one in each)])
    title = f"Tasks per second, {IN_FLIGHT} at a time, one worker on each node"
    return Table(title, ("executor", "workers or nodes", *kinds), rows)


def main() -> None:
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray
    from ray.cluster_utils import Cluster

    print(f"{processor()}, {os.cpu_count()} cores, ray {ray.__version__}, {PLANS} plans, {ROUNDS} rounds\n")
    settings = {"object_store_memory": STORE_BYTES, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **settings})
    try:
        cluster.add_node(num_cpus=1, object_store_memory=STORE_BYTES)
        cluster.wait_for_nodes()
        print(latencies(cluster.address), flush=True)
        add = partial(cluster.add_node, num_cpus=1, object_store_memory=STORE_BYTES)
        print(rates(cluster.address, add), flush=True)
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    main()
