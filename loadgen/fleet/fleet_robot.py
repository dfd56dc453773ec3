"""One robot of a simulated fleet: its own `Offloader`, which waits for nothing but virtual time.

Its sites are modelled in `fleet_servers` and `simulation`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random

from offboard.loadgen.fleet.fleet_servers import ASK, FleetSite, ToRobot, ToServer, number_of
from offboard.loadgen.fleet.fleet_settings import FleetConfig
from offboard.loadgen.play.run_files import ROBOT_SEED_STEP
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.stepped_offloader import SteppedOffloader, Walk, Walker
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S, SITE_NOISE, TASK_NOISE, Noise
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.virtual_site import SimulatedOnboard
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Roster, Server
from offboard.robot_client.policies import Probe
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.heartbeat import Heartbeat
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing.virtual_clock import VirtualClock

NOISES = 65_537  # a prime, so that the noise has another period than the tasks
FIRST_MAX = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Done:
    """One answered task. `server`: where the policy sent it (-1: onboard); `runs`: on how many sites."""

    started_s: float
    waited_s: float
    server: int
    runs: int
    probed: bool


class FleetNoise(Noise):
    """The same noise on the CPU seconds of tasks, from a table that all robots share: they draw it often."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        random = Random(seed)
        self._of_task, self._of_site = (
            [random.lognormvariate(0.0, sigma) for _ in range(NOISES)] for sigma in (TASK_NOISE, SITE_NOISE)
        )

    def factor(self, site: str, task: int) -> float:
        place = 2 * task + (site == ONBOARD)
        return self._of_task[task % NOISES] * self._of_site[place % NOISES]


@dataclass(frozen=True, slots=True)
class Common:
    """What all robots of a fleet have in common.

    - `costs`: of the tasks that they repeat. `listed`: all servers, of which each robot uses a few.
    - `period_s`: the mean time from task to task.
    """

    config: FleetConfig
    costs: TrueCosts
    listed: Sequence[Server]
    period_s: float


class FleetRobot:
    """Asks for its tasks one after the other: each is due some time after the last one, or when that ends.

    `post` sends a message to the servers. `answered` is called after each task.
    """

    def __init__(
        self,
        number: int,
        common: Common,
        clock: VirtualClock,
        *,
        post: Callable[[ToServer], object],
        answered: Callable[[], object],
    ) -> None:
        config = common.config
        seed = config.seed + number * ROBOT_SEED_STEP
        self.done: list[Done] = []
        self.ended = False
        self._number = number
        self._config = config
        self._clock = clock
        self._period_s = common.period_s
        self._post = post
        self._answered = answered
        self._random = Random(seed)
        self._cpu = SimulatedCpu(clock, config.robot_cpus)
        self._first = self._random.randrange(FIRST_MAX)  # so that robots have other tasks and other noise
        self._costs = common.costs
        self._listed, self._seed = common.listed, seed
        self._sites: dict[int, FleetSite] = {}  # every server that it has ever used, by number
        self._present: PresentSites
        self._walker = Walker(clock, self._life())

    def begin(self) -> None:
        self._walker.begin()

    def receive(self, message: ToRobot) -> None:
        if not self.ended:
            self._sites[message.server].receive(message)

    def _life(self) -> Walk:
        yield (), self._random.uniform(0.0, self._config.start_s)
        with self._connect() as offload:
            due_s = self._clock.now_s()
            for number in range(self._config.tasks):
                yield (), due_s - self._clock.now_s()
                yield from self._run(offload, self._first + number, number)
                due_s = max(due_s + self._random.expovariate(1 / self._period_s), self._clock.now_s())
        self.ended = True

    def _run(self, offload: SteppedOffloader, task: int, number: int) -> Walk:
        """One task, from when it is due to its answer."""
        began_s, costs = self._clock.now_s(), self._costs
        yield (), DECIDING_CPU_S / self._cpu.share_of_one_more
        self._tell_oracle(task, number, began_s)
        record = yield from offload.steps(costs.function, costs.task(task).size, task)
        decision, runs = record.decision, len(record.executions)
        self.done.append(
            Done(
                began_s,
                self._clock.now_s() - began_s,
                server=-1 if decision.site == ONBOARD else number_of(decision.site),
                runs=runs,
                probed=isinstance(decision.second, Probe) and runs > 1,
            )
        )
        self._answered()

    def _tell_oracle(self, task: int, number: int, began_s: float) -> None:
        """Ask what the task would take from `began_s` on if the best site were known."""
        now_s, delay_s, costs = self._clock.now_s(), self._config.delay_ms / 1e3, self._costs
        deciding_s, sending_s = now_s - began_s, costs.cost.sending_s / self._cpu.share_of_one_more
        onboard_s = deciding_s + costs.seconds(ONBOARD, task) / self._cpu.share(1)
        # It arrives with the request, and the rest of the robot's own time is added to that on the server.
        cpu_s = deciding_s + sending_s + costs.seconds(CLOUD, task)
        arrives_s = now_s + sending_s / 2 + delay_s
        ways = tuple(number_of(site) for site in self._present if site != ONBOARD)
        ask = ToServer(
            arrives_s, ASK, self._number, -1, number=number, cpu_s=cpu_s, limit_s=onboard_s, ways=ways
        )
        self._post(ask)

    def _connect(self) -> SteppedOffloader:
        config = self._config
        settings = Settings(heartbeats=config.heartbeats, seed=self._seed)
        policy = config.policy
        every_s = heartbeat.EVERY_S if settings.beats(policy) else 0.0
        self._present = PresentSites(
            [SimulatedOnboard(self._clock, self._cpu, self._costs)],
            roster=Roster(config.known, self._seed),
            connect=partial(self._use, every_s),
            clock_s=self._clock.now_s,
        )
        self._present.follow(self._listed)
        return SteppedOffloader(
            self._present,
            policy=settings.make_policy(policy),
            memories=settings.make_memories(policy),
            timeout_s=config.timeout_s,
            clock=self._clock,
        )

    def _use(self, every_s: float, server: Server) -> FleetSite:
        """Connect to a server, with a heartbeat after this time."""
        number = number_of(server.site)
        self._sites[number] = FleetSite(
            self._clock,
            self._cpu,
            self._costs,
            site=server.site,
            heartbeat=Heartbeat(every_s, self._seed + number),
            robot=self._number,
            delay_s=self._config.delay_ms / 1e3,
            post=self._post,
        )
        return self._sites[number]
