"""The tasks of a simulated robot, with the work that each of them really is.

They are the tasks of a real run with the same seed: the workload of the robot makes them, and the real
planner plans each of them once. What their work costs is in `true_costs.py`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind, Size, kind_of
from offboard.common.wire import messages as wire
from offboard.loadgen.robot.work import make_work
from offboard.loadgen.scenario.scenario import Workload
from offboard.loadgen.simulation.model.task_costs import COSTS, PARTS, PLANS, ROUNDS, Cost

HASH_BYTES = bytes(32)  # as long as the answers of offboard.loadgen.scenario.hash_tasks
OTHERS_TASKS_MAX = 50  # tasks of each other robot, which repeats them


@dataclass(frozen=True, slots=True)
class SimulatedTask:
    """One task: its input size, its work on each site, and the bytes of its request and reply."""

    size: Size
    work: Mapping[str, float]
    bytes_out: int
    bytes_in: int


@dataclass(frozen=True, slots=True)
class RobotTasks:
    """The tasks of one robot, in order.

    - `reports_work`: the answers say how much work the task was.
    - `blob_bytes`: large arguments, which are sent once.
    """

    tasks: Sequence[SimulatedTask]
    cost: Cost
    reports_work: bool
    blob_bytes: int = 0

    def first(self, count: int) -> "RobotTasks":
        return replace(self, tasks=self.tasks[:count])


def find_tasks(workload: Workload, seed: int, count: int) -> RobotTasks:
    """The first `count` tasks of a robot with this seed; ConfigError if their costs are not known."""
    work = make_work(replace(workload, reference=0, alone=0).robot(seed))
    kind = kind_of(work.function)
    if kind.name not in COSTS:
        known = ", ".join(COSTS)
        raise ConfigError(f"task {kind.name} cannot be simulated: only the costs of {known} are known")
    if kind.warm is not None:
        kind.warm()
    fresh = workload.inputs is not None  # new arrays travel inside the request
    blobs = wire.encode(list(work.request()), kind.types, blobs=not fresh).blobs
    tasks = []
    for _ in range(count):
        request = work.request()
        if kind.name in ROUNDS:
            answer, units = None, {site: float(ROUNDS[kind.name](site, request[0])) for site in PARTS}
        else:
            answer = work.function(*request)
            units = dict.fromkeys(PARTS, kind.work_of(answer) or 0.0)
        body = wire.encode(list(request), kind.types, blobs=not fresh)
        answer_or_hash = HASH_BYTES if answer is None else answer
        tasks.append(_task(kind, request, body=body, answer=answer_or_hash, units=units))
        work.advance(answer)
    blob_bytes = sum(raw.nbytes for raw in blobs.values())
    cost = PLANS[workload.planner] if kind.name == "plan_path" else COSTS[kind.name]
    return RobotTasks(tasks, cost, kind.work is not None, blob_bytes)


def _task(
    kind: Kind, request: tuple[Any, ...], *, body: wire.Body, answer: Any, units: Mapping[str, float]
) -> SimulatedTask:
    """The bytes are counted on the messages that a real robot and server would send."""
    frames = wire.pack(wire.Request(1, kind.name, 1.0, blobs=tuple(body.blobs), body=body.frames))
    reply = wire.Reply(1, "ok", run_s=1.0, body=wire.encode(answer, kind.types).frames, cpu_s=1.0)
    size = kind.size_of(kind.bind(request, {}))
    return SimulatedTask(size, units, wire.byte_count(frames), wire.byte_count(wire.pack(reply)))
