"""The tasks of a simulated robot, and what they cost: CPU seconds and bytes, as measured, and noise.

The tasks are those of a real run with the same seed: the workload of the robot makes them, and the real
planner plans each of them once. All costs were measured on a virtual machine with two cores:

- CPU seconds: least squares on the work that answers reported, in `loadgen run calm`, `nonlinear` and
  `robot-busy`. A plan takes 1.4e-8 to 1.6e-8 s per cell, and 0.7 to 1.2 ms more on the server. A round of
  PBKDF2 takes 2.3e-7 s onboard, 2.7e-7 s on the server, and 2.2e-7 s in a loop.
- A cell of A* and a jump point: 2.1 and 84 times a cell of Dijkstra, in the same loop over 60 plans on Willow
  Garage at 0.025 m. At 0.05 m a jump point took a third of that.
- Sending: the median of network_s minus the round trip, times the CPU quota of the robot.
- Noise: the logarithm of `cpu_s` varies by 0.16 to 0.22. In a loop over 100 plans it varied by 0.07 to 0.13
  from plan to plan, and by 0.09 to 0.19 from run to run.
- Start: `took_s` of the server's start in `cloud-restart`. Bytes: packed messages.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.planning import ASTAR, DIJKSTRA, JPS
from offboard.common.tasks import Kind, Size, kind_of
from offboard.common.wire import messages as wire
from offboard.loadgen.robot.stream_policy import followed
from offboard.loadgen.robot.work import make_work
from offboard.loadgen.scenario.hash_tasks import EVERYWHERE, frame_rounds, image_rounds, rounds_on
from offboard.loadgen.scenario.scenario import Workload
from offboard.loadgen.testbed.testbed import CLOUD as CLOUD_PART
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

DECIDING_CPU_S = 0.3e-3  # CPU of the robot to predict, decide, learn and record one task
TASK_NOISE = 0.1  # standard deviation of log(cpu_s) between tasks of equal work, the same on every site
SITE_NOISE = 0.1  # and between runs of one task
START_S = 1.9  # from the start of a server until it is ready
BEAT_BYTES, BEAT_REPLY_BYTES, CANCEL_BYTES, MISSING_BYTES = 12, 25, 14, 143
HELLO_BYTES = 1000
HASH_BYTES = bytes(32)  # as long as the answers of offboard.loadgen.scenario.hash_tasks
OTHERS_TASKS_MAX = 50  # tasks of each other robot, which repeats them


@dataclass(frozen=True, slots=True)
class Cost:
    """The CPU seconds of a task on a full CPU: `fixed_s`, plus `s_per_unit` for each unit of work.

    `sending_s` is the CPU time of the robot to pack and send a request, and to receive and unpack the reply.
    """

    fixed_s: float
    s_per_unit: float
    sending_s: float

    def cpu_s(self, work: float) -> float:
        return self.fixed_s + self.s_per_unit * work


PLAN = Cost(fixed_s=0.3e-3, s_per_unit=1.5e-8, sending_s=1.1e-3)  # unit: a cell that the search settles
HASH = Cost(fixed_s=0.2e-3, s_per_unit=2.4e-7, sending_s=0.4e-3)  # unit: a round of PBKDF2-HMAC-SHA256
PLANS: Mapping[str, Cost] = {  # by planner
    DIJKSTRA: PLAN,
    ASTAR: replace(PLAN, s_per_unit=3.2e-8),
    JPS: replace(PLAN, s_per_unit=1.3e-6),  # unit: a jump point
}

# By kind. The work of the kinds in offboard.loadgen.scenario.hash_tasks follows from their argument.
COSTS: Mapping[str, Cost] = {
    "plan_path": PLAN,
    "hash_rounds": HASH,
    "hash_pairs": HASH,
    "hash_rarely_long": HASH,
    "hash_rarely_long_everywhere": HASH,
    "look_at_frame": replace(HASH, sending_s=0.9e-3),  # 0.9 ms more for each MB
    "look_at_any_frame": replace(HASH, sending_s=0.9e-3),
    "judge_image": replace(HASH, sending_s=1.2e-3),
    "follow": Cost(fixed_s=0.0, s_per_unit=1.0, sending_s=0.4e-3),  # it sleeps, and needs no CPU
}
PARTS = {ONBOARD: ROBOT, CLOUD: CLOUD_PART}  # the part of the testbed that runs a site
ROUNDS: Mapping[str, Callable[[str, Any], float]] = {
    "hash_rounds": lambda _, rounds: rounds,
    "hash_pairs": lambda _, count: count * count // 1000,
    "hash_rarely_long": lambda site, rounds: rounds_on(PARTS[site], rounds),
    "hash_rarely_long_everywhere": lambda _, rounds: rounds_on(EVERYWHERE, rounds),
    "look_at_frame": lambda _, frame: frame_rounds(frame),
    "look_at_any_frame": lambda _, frame: frame_rounds(frame),
    "judge_image": lambda site, _: image_rounds(PARTS[site]),
    "follow": lambda site, observation: float(observation[f"{site}_s"]),
}


class Noise:
    """Random factors on the CPU seconds of tasks, which depend only on seed, task and site.

    So a task takes the same time on a site, whatever was decided before. A `scale` of 0 means no noise.
    """

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        self._seed = seed
        self._scale = scale

    def factor(self, site: str, task: int) -> float:
        of_task = Random(f"{self._seed}/{task}").gauss(0.0, TASK_NOISE * self._scale)
        return Random(f"{self._seed}/{site}/{task}").lognormvariate(of_task, SITE_NOISE * self._scale)


@dataclass(frozen=True, slots=True)
class SimulatedTask:
    """One task: its input size, its work on each site, and the bytes of its request and reply.

    answer: the chunk of a stream.
    """

    size: Size
    work: Mapping[str, float]
    bytes_out: int
    bytes_in: int
    answer: Any = None


@dataclass(frozen=True, slots=True)
class RobotTasks:
    """The tasks of one robot, in order.

    - `reports_work`: the answers say how much work the task was.
    - `blob_bytes`: large arguments, which are sent once.
    - `streams`: the tasks are chunks.
    """

    tasks: Sequence[SimulatedTask]
    cost: Cost
    reports_work: bool
    blob_bytes: int = 0
    streams: bool = False

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
            answer, units = (
                (followed(request[0]) if workload.streams else None),
                {site: float(ROUNDS[kind.name](site, request[0])) for site in PARTS},
            )
        else:
            answer = work.function(*request)
            units = dict.fromkeys(PARTS, kind.work_of(answer) or 0.0)
        body = wire.encode(list(request), kind.types, blobs=not fresh)
        answer_or_hash = HASH_BYTES if answer is None else answer
        made = _task(kind, request, body=body, answer=answer_or_hash, units=units)
        tasks.append(replace(made, answer=answer) if workload.streams else made)
        work.advance(answer)
    blob_bytes = sum(raw.nbytes for raw in blobs.values())
    cost = PLANS[workload.planner] if kind.name == "plan_path" else COSTS[kind.name]
    return RobotTasks(tasks, cost, kind.work is not None, blob_bytes, streams=workload.streams)


def _task(
    kind: Kind, request: tuple[Any, ...], *, body: wire.Body, answer: Any, units: Mapping[str, float]
) -> SimulatedTask:
    """The bytes are counted on the messages that a real robot and server would send."""
    frames = wire.pack(wire.Request(1, kind.name, 1.0, blobs=tuple(body.blobs), body=body.frames))
    reply = wire.Reply(1, "ok", run_s=1.0, body=wire.encode(answer, kind.types).frames, cpu_s=1.0)
    size = kind.size_of(kind.bind(request, {}))
    return SimulatedTask(size, units, wire.byte_count(frames), wire.byte_count(wire.pack(reply)))
