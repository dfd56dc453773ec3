"""The planning server in a simulation: requests in line for its workers, crashes, hangs and cold starts."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from offboard.common.host.load import HURRIED_S, SERVER_EVERY_S
from offboard.loadgen.scenario.scenario import CloudPart
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import START_S
from offboard.loadgen.simulation.model.measured_load import SimulatedLoad
from offboard.loadgen.simulation.model.processor import Processor, Run
from offboard.robot_client.sites.heartbeat import ServerReport

QUEUE_MAX = 64  # requests in line, as `cloud-server` has it; beyond it the answer is busy
UNREAD_MAX = 100_000  # messages that a paused server has not read

OK, BUSY, NEED_BLOB = "ok", "busy", "need_blob"
Key = tuple[str, int]  # robot, and the number that it gave the request


@dataclass(frozen=True, slots=True)
class Reply:
    """What the server says to a request, and of itself when it does."""

    status: str
    told: ServerReport
    queue_s: float = 0.0
    run_s: float = 0.0
    cpu_s: float = 0.0


class Server:
    """`lost` of every robot in `listeners` is called when its connection breaks with the server."""

    def __init__(self, clock: VirtualClock, part: CloudPart) -> None:
        self.up = True
        self.listeners: list[Callable[[], None]] = []
        self.processor = Processor(clock, part.cpus, part.workers)
        self._load = SimulatedLoad(clock, self.processor)
        clock.after(SERVER_EVERY_S, self._look)
        self._clock = clock
        self._has_blob = True  # robots have warmed it up before the run
        self._paused = False
        self._unread: deque[Callable[[], object]] = deque()
        self._wanted: dict[Key, Run] = {}
        self._life = 0

    @property
    def queue(self) -> int:
        return self.processor.waiting

    @property
    def told(self) -> ServerReport:
        """What it says of itself."""
        return ServerReport(self.queue, self._load.latest, self._load.capacity)

    def _look(self) -> None:
        self._load.share(SERVER_EVERY_S)
        self._clock.after(SERVER_EVERY_S, self._look)

    def hear(self, message: Callable[[], object]) -> None:
        """A message has arrived."""
        if self.up and not self._paused:
            message()
        elif self.up and len(self._unread) < UNREAD_MAX:
            self._unread.append(message)

    def request(self, key: Key, cpu_s: float, budget_s: float, answer: Callable[[Reply], object]) -> None:
        """Put it in line; `answer` is called when it has run, unless its budget was over before it began."""
        if not self._has_blob:
            answer(Reply(NEED_BLOB, self.told))
        elif self.queue >= QUEUE_MAX:
            answer(Reply(BUSY, self.told))
        else:
            self._wanted[key] = self.processor.add(
                cpu_s,
                partial(self._ended, key, cpu_s, answer),
                owner=key[0],
                until_s=self._clock.now_s() + budget_s,
            )

    def take_blob(self) -> None:
        self._has_blob = True

    def cancel(self, key: Key) -> None:
        """What runs goes on, and nobody hears of it."""
        run = self._wanted.pop(key, None)
        if run is not None:
            self.processor.drop(run)

    def kill(self) -> None:
        """All that it knew is gone, and every robot's connection breaks."""
        self.up = self._paused = self._has_blob = False
        self._life += 1
        self.processor.clear()
        self._unread.clear()
        self._wanted.clear()
        for lost in self.listeners:
            lost()

    def start(self) -> None:
        """Up once it is warm; nothing happens to one that runs."""
        if not self.up:
            self._life += 1
            self._clock.after(START_S, partial(self._ready, self._life))

    def pause(self, paused: bool) -> None:
        """Stopped where it is, or going on with all that has come meanwhile."""
        if not self.up:
            return
        self._paused = paused
        self.processor.change(paused=paused)
        while self._unread and not self._paused:
            self._unread.popleft()()

    def _ready(self, life: int) -> None:
        self.up = self.up or life == self._life

    def _ended(self, key: Key, cpu_s: float, answer: Callable[[Reply], object], run: Run) -> None:
        if self._wanted.pop(key, None) is not None:
            queue_s, run_s = run.begun_s - run.added_s, self._clock.now_s() - run.begun_s
            self._load.share(HURRIED_S)
            answer(Reply(OK, self.told, queue_s, run_s, cpu_s))
