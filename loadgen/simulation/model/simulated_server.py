"""The simulated planning server: requests that wait for its workers, crashes, pauses and cold starts."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from offboard.common.load import HURRIED_S, SERVER_EVERY_S
from offboard.loadgen.scenario.scenario import CloudPart
from offboard.loadgen.simulation.model.simulated_cpu import Run, SimulatedCpu, SimulatedLoad
from offboard.loadgen.simulation.model.task_costs import START_S
from offboard.robot_client.sites.heartbeat import ServerReport
from offboard.testing.virtual_clock import VirtualClock

QUEUE_MAX = 64  # requests that wait, as in `cloud-server`; further requests are refused as busy
UNREAD_MAX = 100_000  # messages that a paused server has not read

OK, BUSY, NEED_BLOB = "ok", "busy", "need_blob"
Key = tuple[str, int]  # robot, and the number that the robot gave to the request


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to a request; `told` is the state that the server reports with it."""

    status: str
    told: ServerReport
    queue_s: float = 0.0
    run_s: float = 0.0
    cpu_s: float = 0.0


class SimulatedServer:
    """Runs requests on a simulated CPU.

    `listeners` are called when the server crashes: one for each robot, to break its connection.
    """

    def __init__(self, clock: VirtualClock, part: CloudPart) -> None:
        self.up = True
        self.listeners: list[Callable[[], None]] = []
        self.cpu = SimulatedCpu(clock, part.cpus, part.workers)
        self._load = SimulatedLoad(clock, self.cpu)
        clock.after(SERVER_EVERY_S, self._measure_load)
        self._clock = clock
        self._has_blob = True  # the robots have sent it before the run
        self._paused = False
        self._unread: deque[Callable[[], object]] = deque()
        self._wanted: dict[Key, Run] = {}
        self._life = 0

    @property
    def told(self) -> ServerReport:
        """The state that the server reports with every reply: its queue, its load, its capacity."""
        return ServerReport(self.cpu.waiting, self._load.latest, self._load.capacity)

    def _measure_load(self) -> None:
        self._load.share(SERVER_EVERY_S)
        self._clock.after(SERVER_EVERY_S, self._measure_load)

    def receive(self, message: Callable[[], object]) -> None:
        """Act on a message that has arrived; a paused server acts on it later."""
        if self.up and not self._paused:
            message()
        elif self.up and len(self._unread) < UNREAD_MAX:
            self._unread.append(message)

    def request(self, key: Key, cpu_s: float, budget_s: float, answer: Callable[[Reply], object]) -> None:
        """Put a request into the queue.

        `answer` is called when it has run. It is not called if the budget is over before the run begins.
        """
        if not self._has_blob:
            answer(Reply(NEED_BLOB, self.told))
        elif self.cpu.waiting >= QUEUE_MAX:
            answer(Reply(BUSY, self.told))
        else:
            self._wanted[key] = self.cpu.add(
                cpu_s,
                partial(self._ended, key, cpu_s, answer),
                owner=key[0],
                until_s=self._clock.now_s() + budget_s,
            )

    def take_blob(self) -> None:
        self._has_blob = True

    def cancel(self, key: Key) -> None:
        """Drop a request. If it already runs, it runs to its end, and its answer is not sent."""
        run = self._wanted.pop(key, None)
        if run is not None:
            self.cpu.drop(run)

    def kill(self) -> None:
        """The server crashes: it loses all its state, and every connection breaks."""
        self.up = self._paused = self._has_blob = False
        self._life += 1
        self.cpu.clear()
        self._unread.clear()
        self._wanted.clear()
        for lost in self.listeners:
            lost()

    def start(self) -> None:
        """Start a server that is down; it is up after its warm-up."""
        if not self.up:
            self._life += 1
            self._clock.after(START_S, partial(self._ready, self._life))

    def pause(self) -> None:
        """Stop the server where it is, as SIGSTOP does."""
        if self.up:
            self._paused = True
            self.cpu.change(paused=True)

    def resume(self) -> None:
        """Continue, and act on all messages that arrived during the pause."""
        if not self.up:
            return
        self._paused = False
        self.cpu.change(paused=False)
        while self._unread and not self._paused:
            self._unread.popleft()()

    def _ready(self, life: int) -> None:
        self.up = self.up or life == self._life

    def _ended(self, key: Key, cpu_s: float, answer: Callable[[Reply], object], run: Run) -> None:
        if self._wanted.pop(key, None) is not None:
            queue_s, run_s = run.begun_s - run.added_s, self._clock.now_s() - run.begun_s
            self._load.share(HURRIED_S)
            answer(Reply(OK, self.told, queue_s=queue_s, run_s=run_s, cpu_s=cpu_s))
