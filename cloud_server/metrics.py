"""The figures that the server counts, and its status; `http_api` shows them."""

import time
from collections.abc import Callable, Generator
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from offboard.common.live.look import Look

LABELS_MAX = 1024  # counters of one metric that are kept at hand: looking one up by its labels takes longer
COUNTED_S = 10.0  # after the last look
ROBOTS_MAX = 256  # robots that the page /live tells apart; further ones are counted together
OTHERS = b""  # the name of the further ones
COUNT_BUCKETS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 256)
SECONDS_BUCKETS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)


@dataclass(frozen=True, slots=True)
class Status:
    """The state of the server at one moment. Ages are in seconds; None if nothing has happened yet.

    places: how many workers are up on which computer.
    """

    ready: bool
    draining: bool
    queue_depth: int
    running: int
    executor: str
    places: dict[str, int]
    uptime_s: float
    last_turn_age_s: float
    last_task_age_s: float | None


@dataclass(slots=True)
class RobotUse:
    """What one robot asked of this server since it is counted."""

    tasks: int = 0
    queue_s: float = 0.0
    run_s: float = 0.0
    refused: int = 0


class RobotUses:
    """What each robot asks of this server. `counting`: somebody looks at /live, so a use must be noted."""

    def __init__(self) -> None:
        self.counting = False
        self._until_s = 0.0
        self._uses: dict[bytes, RobotUse] = {}

    def look(self) -> None:
        """Somebody looks. Counting ends COUNTED_S after the last look: a page asks for a new stream often."""
        self._until_s = time.monotonic() + COUNTED_S
        self.counting = True

    def of(self, robot: bytes) -> RobotUse:
        if time.monotonic() > self._until_s:
            self.counting = False
            self._uses = {}
            return RobotUse()  # for the last robot that is noted, and then forgotten
        if robot not in self._uses and len(self._uses) >= ROBOTS_MAX:
            robot = OTHERS
        return self._uses.setdefault(robot, RobotUse())

    def counted(self) -> dict[bytes, dict[str, Any]]:
        return {robot: asdict(use) for robot, use in self._uses.items()}


class Metrics:
    """The Prometheus metrics of one server, in a registry of their own."""

    def __init__(self) -> None:
        self.robots = RobotUses()
        self.registry = CollectorRegistry()
        counter, gauge = partial(Counter, registry=self.registry), partial(Gauge, registry=self.registry)
        seconds = partial(Histogram, labelnames=["kind"], buckets=SECONDS_BUCKETS, registry=self.registry)
        requests = counter("offboard_server_requests", "Requests by outcome", ["kind", "status"])
        self.requests_of = lru_cache(LABELS_MAX)(requests.labels)
        self.queue_depth = gauge("offboard_server_waiting_requests", "Requests waiting for a worker")
        self.running = gauge("offboard_server_running_tasks", "Tasks running")
        self.up = gauge("offboard_server_up_workers", "Workers that run a task or can take one", ["executor"])
        queue_s = seconds("offboard_server_queue_seconds", "Time from arrival to start")
        self.queue_s_of = lru_cache(LABELS_MAX)(queue_s.labels)
        run_s = seconds("offboard_server_run_seconds", "Time in the worker")
        self.run_s_of = lru_cache(LABELS_MAX)(run_s.labels)
        together = Histogram(
            "offboard_server_run_requests",
            "Requests that ran in one call, of kinds that run together",
            ["kind"],
            buckets=COUNT_BUCKETS,
            registry=self.registry,
        )
        self.together_of = lru_cache(LABELS_MAX)(together.labels)
        held_s = seconds("offboard_server_held_seconds", "Time that a run waited for more requests")
        self.held_s_of = lru_cache(LABELS_MAX)(held_s.labels)
        too_late = "Requests refused because their answers would come too late"
        self.too_late = counter("offboard_server_too_late_requests", too_late, ["kind"])
        self.bytes_in = counter("offboard_server_received_bytes", "Bytes of messages received")
        self.bytes_out = counter("offboard_server_sent_bytes", "Bytes of messages sent")
        self.blob_bytes = gauge("offboard_server_blob_bytes", "Bytes of stored large arguments")
        self.load = gauge("offboard_server_other_load_ratio", "Share of the CPU that other programs take")
        self.capacity = gauge("offboard_server_task_cpu_ratio", "Share of one CPU that a task may use")
        dropped = "Messages and replies that were dropped"
        self.dropped = counter("offboard_server_dropped_messages", dropped, ["reason"])
        self.refused = counter("offboard_server_refused_handshakes", "Handshakes with an unknown key")
        cut_off = "Connections closed because they sent too much"
        self.cut_off = counter("offboard_server_cut_off_connections", cut_off)
        restarts = "Workers that died and were replaced"
        self.restarts = counter("offboard_server_worker_restarts", restarts, ["reason"])


class ServerLive:
    """The source of the server's page /live. `robots`: what each robot asks of the server."""

    def __init__(
        self,
        metrics: Metrics,
        status: Callable[[], Status],
        robots: Callable[[], list[dict[str, Any]]],
        workers: int,
    ) -> None:
        self._metrics = metrics
        self._status = status
        self._robots = robots
        self._workers = workers

    def looks(self) -> Generator[Look]:
        while True:
            self._metrics.robots.look()
            state = {"workers": self._workers, "robots": self._robots(), "samples": self._samples()}
            yield Look("server", time.time(), server={**asdict(self._status()), **state})

    def _samples(self) -> list[tuple[str, dict[str, str], float]]:
        """Every metric but the buckets of histograms: name, labels, value."""
        return [
            (sample.name, dict(sample.labels), sample.value)
            for family in self._metrics.registry.collect()
            for sample in family.samples
            if not sample.name.endswith(("_bucket", "_created"))
        ]
