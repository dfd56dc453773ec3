"""The tasks that a robot of a scenario asks for, with the work that each truly is.

They are those of a real run with this seed: made by the robot's own workload, planned once by the planner.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind, kind_of
from offboard.common.wire import messages as wire
from offboard.loadgen.scenario.scenario import Workload
from offboard.loadgen.simulation.model.costs import COSTS, PARTS, PLANS, ROUNDS, Cost
from offboard.robot_client.simulated.work import make_work

HASH_BYTES = bytes(32)  # a value as long as the answers of offboard.loadgen.scenario.hash_tasks
OTHERS_TASKS_MAX = 50  # tasks of each other robot, which asks for them again and again


@dataclass(frozen=True, slots=True)
class Asked:
    """One task: input size, work on each site, and the bytes of its request and reply."""

    size: float
    work: Mapping[str, float]
    bytes_out: int
    bytes_in: int


@dataclass(frozen=True, slots=True)
class Tasks:
    """Those of one robot in their order; `told`: results say their work; `blob_bytes` go ahead once."""

    asked: Sequence[Asked]
    cost: Cost
    told: bool
    blob_bytes: int = 0

    def first(self, count: int) -> "Tasks":
        return replace(self, asked=self.asked[:count])


def find_tasks(workload: Workload, seed: int, count: int) -> Tasks:
    """The first `count` tasks of a robot with this seed; ConfigError where nobody knows what they cost."""
    work = make_work(replace(workload, reference=0, alone=0).robot(seed))
    kind = kind_of(work.function)
    if kind.name not in COSTS:
        known = ", ".join(COSTS)
        raise ConfigError(f"task {kind.name} cannot be simulated: only the costs of {known} are known")
    if kind.warm is not None:
        kind.warm()
    blobs = wire.encode(list(work.request()), kind.types, blobs=True).blobs
    asked = []
    for _ in range(count):
        request = work.request()
        if kind.name in ROUNDS:
            answer, units = None, {site: float(ROUNDS[kind.name](site, request[0])) for site in PARTS}
        else:
            answer = work.function(*request)
            units = dict.fromkeys(PARTS, kind.work_of(answer) or 0.0)
        asked.append(_asked(kind, request, HASH_BYTES if answer is None else answer, units))
        work.advance(answer)
    blob_bytes = sum(raw.nbytes for raw in blobs.values())
    cost = PLANS[workload.planner] if kind.name == "plan_path" else COSTS[kind.name]
    return Tasks(asked, cost, kind.work is not None, blob_bytes)


def _asked(kind: Kind, request: tuple[Any, ...], answer: Any, units: Mapping[str, float]) -> Asked:
    """The bytes are those of the messages that would be sent."""
    body = wire.encode(list(request), kind.types, blobs=True)
    frames = wire.pack(wire.Request(1, kind.name, 1.0, 1, tuple(body.blobs), body.frames))
    reply = wire.Reply(1, "ok", "", 0.0, 1.0, 0, body=wire.encode(answer, kind.types).frames, cpu_s=1.0)
    size = kind.size_of(kind.bind(request, {}))
    return Asked(size, units, wire.byte_count(frames), wire.byte_count(wire.pack(reply)))
