"""The figures that the server counts, and its status.

`http_api` shows them.
"""

from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

SECONDS_BUCKETS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)


@dataclass(frozen=True, slots=True)
class Status:
    """The state of the server at one moment. Ages are in seconds; None if nothing has happened yet."""

    ready: bool
    draining: bool
    queue_depth: int
    running: int
    uptime_s: float
    last_turn_age_s: float
    last_task_age_s: float | None


class Metrics:
    """The Prometheus metrics of one server, in a registry of their own."""

    def __init__(self) -> None:
        r = self.registry = CollectorRegistry()
        self.requests = Counter(
            "offboard_server_requests", "Requests by outcome", ["kind", "status"], registry=r
        )
        self.queue_depth = Gauge(
            "offboard_server_waiting_requests", "Requests waiting for a worker", registry=r
        )
        self.running = Gauge("offboard_server_running_tasks", "Tasks running", registry=r)
        self.queue_s = Histogram(
            "offboard_server_queue_seconds",
            "Time from arrival to start",
            ["kind"],
            buckets=SECONDS_BUCKETS,
            registry=r,
        )
        self.run_s = Histogram(
            "offboard_server_run_seconds", "Time in the worker", ["kind"], buckets=SECONDS_BUCKETS, registry=r
        )
        self.bytes_in = Counter("offboard_server_received_bytes", "Bytes of messages received", registry=r)
        self.bytes_out = Counter("offboard_server_sent_bytes", "Bytes of messages sent", registry=r)
        self.blob_bytes = Gauge("offboard_server_blob_bytes", "Bytes of stored large arguments", registry=r)
        self.load = Gauge(
            "offboard_server_other_load_ratio", "Share of the CPU that other programs take", registry=r
        )
        self.capacity = Gauge(
            "offboard_server_task_cpu_ratio", "Share of one CPU that a task may use", registry=r
        )
        self.dropped = Counter(
            "offboard_server_dropped_messages",
            "Messages and replies that were dropped",
            ["reason"],
            registry=r,
        )
        self.refused = Counter(
            "offboard_server_refused_handshakes", "Handshakes with an unknown key", registry=r
        )
        self.cut_off = Counter(
            "offboard_server_cut_off_connections", "Connections closed because they sent too much", registry=r
        )
        self.restarts = Counter(
            "offboard_server_worker_restarts", "Workers that died and were replaced", ["reason"], registry=r
        )
