"""What tasks cost in a simulation: CPU seconds and bytes, as measured, and the noise on them.

All values were measured on a virtual machine with two cores:

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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from offboard.common.planning.planner_names import ASTAR, DIJKSTRA, JPS
from offboard.loadgen.scenario.hash_tasks import EVERYWHERE, frame_rounds, image_rounds, rounds_on
from offboard.loadgen.testbed.testbed import CLOUD as CLOUD_PART
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

DECIDING_CPU_S = 0.3e-3  # CPU of the robot to predict, decide, learn and record one task
TASK_NOISE = 0.1  # standard deviation of log(cpu_s) between tasks of equal work, the same on every site
SITE_NOISE = 0.1  # and between runs of one task
START_S = 1.9  # from the start of a server until it is ready
BEAT_BYTES, BEAT_REPLY_BYTES, CANCEL_BYTES, MISSING_BYTES = 12, 25, 14, 143
HELLO_BYTES = 1000


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
}
PARTS = {ONBOARD: ROBOT, CLOUD: CLOUD_PART}  # the part of the testbed that runs a site
ROUNDS: Mapping[str, Callable[[str, Any], int]] = {
    "hash_rounds": lambda _, rounds: rounds,
    "hash_pairs": lambda _, count: count * count // 1000,
    "hash_rarely_long": lambda site, rounds: rounds_on(PARTS[site], rounds),
    "hash_rarely_long_everywhere": lambda _, rounds: rounds_on(EVERYWHERE, rounds),
    "look_at_frame": lambda _, frame: frame_rounds(frame),
    "look_at_any_frame": lambda _, frame: frame_rounds(frame),
    "judge_image": lambda site, _: image_rounds(PARTS[site]),
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
