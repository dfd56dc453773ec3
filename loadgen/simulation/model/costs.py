"""What tasks cost in a simulation: CPU seconds and bytes, as measured, and the noise on them, from the seed.

How these were measured, on a virtual machine of two cores: CPU of tasks by least squares on the work of the
answers of `loadgen run calm`, `nonlinear` and `robot-busy`. A plan's `cpu_s` has 1.4e-8 to 1.6e-8 s a cell,
and 0.7 to 1.2 ms more on the server, next to nothing onboard; a round of PBKDF2 2.3e-7 s onboard, 2.7e-7 on
the server, 2.2e-7 in a loop by itself. Sending: median of network_s less the round trip, times the robot's
quota. Noise: 0.16 to 0.22 are left of the logarithm of `cpu_s`; of a loop over 100 plans 0.07 to 0.13 from
plan to plan, 0.09 to 0.19 from run to run. Start: `took_s` of the start in `cloud-restart`. Bytes: of
packed messages. A cell of A* and a jump point: 2.1 and 84 times what Dijkstra's cell took in the same loop
over 60 plans on Willow Garage at 0.025 m; at 0.05 m a jump point took a third of that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from random import Random

from offboard.common.planning.planner_names import ASTAR, DIJKSTRA, JPS
from offboard.loadgen.scenario.hash_tasks import rounds_on
from offboard.loadgen.testbed.testbed import CLOUD as CLOUD_PART
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

DECIDING_CPU_S = 0.3e-3  # of the robot: predict, decide, learn and record one task
TASK_NOISE = 0.1  # standard deviation of the logarithm: what the work does not tell, the same on every site
SITE_NOISE = 0.1  # and what differs from run to run
START_S = 1.9  # from the start of a server until it is ready
BEAT_BYTES, BEAT_REPLY_BYTES, CANCEL_BYTES, MISSING_BYTES = 12, 25, 14, 143
HELLO_BYTES = 1000


@dataclass(frozen=True, slots=True)
class Cost:
    """CPU seconds of a kind's tasks at a whole CPU: `fixed_s`, and `s_a_unit` for each unit of work.

    `sending_s`: of the robot, to pack a request, send it, receive the reply and unpack it.
    """

    fixed_s: float
    s_a_unit: float
    sending_s: float

    def cpu_s(self, work: float) -> float:
        return self.fixed_s + self.s_a_unit * work


PLAN = Cost(fixed_s=0.3e-3, s_a_unit=1.5e-8, sending_s=1.1e-3)  # unit: a cell that the search settles
HASH = Cost(fixed_s=0.2e-3, s_a_unit=2.4e-7, sending_s=0.4e-3)  # unit: a round of PBKDF2-HMAC-SHA256
PLANS: Mapping[str, Cost] = {  # by planner
    DIJKSTRA: PLAN,
    ASTAR: replace(PLAN, s_a_unit=3.2e-8),
    JPS: replace(PLAN, s_a_unit=1.3e-6),  # unit: a jump point
}

# By kind; the work of those of offboard.loadgen.scenario.hash_tasks follows from their number.
COSTS: Mapping[str, Cost] = {
    "plan_path": PLAN,
    "hash_rounds": HASH,
    "hash_pairs": HASH,
    "hash_rarely_long": HASH,
}
PARTS = {ONBOARD: ROBOT, CLOUD: CLOUD_PART}  # the part of a testbed that a site is
ROUNDS: Mapping[str, Callable[[str, int], int]] = {
    "hash_rounds": lambda _, rounds: rounds,
    "hash_pairs": lambda _, count: count * count // 1000,
    "hash_rarely_long": lambda site, rounds: rounds_on(PARTS[site], rounds),
}


class Noise:
    """Factors on the CPU seconds of a run's tasks; each depends on seed, task and site alone.

    So the same task takes the same on the same site, whatever was decided before. `scale` 0: no noise.
    """

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        self._seed = seed
        self._scale = scale

    def factor(self, site: str, task: int) -> float:
        of_task = Random(f"{self._seed}/{task}").gauss(0.0, TASK_NOISE * self._scale)
        return Random(f"{self._seed}/{site}/{task}").lognormvariate(of_task, SITE_NOISE * self._scale)
