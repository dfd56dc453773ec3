"""The Prometheus metrics of the robot, updated with the record of every task.

The records are made in `offloader`.
"""

import logging
from collections.abc import Iterator
from threading import Thread
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server
from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from offboard.common.errors import ConfigError
from offboard.robot_client.records.trace import Record, Trace
from offboard.robot_client.sites.runner import PORT_MAX, Execution

SECONDS_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)

REGRET = {
    "": "Mean seconds per task that the better site would have saved",
    "_low": "Lower end of the 90 % interval of robot_regret_seconds",
    "_high": "Upper end of the 90 % interval of robot_regret_seconds",
}

log = logging.getLogger(__name__)


class Metrics:
    """An observer of the offloader that counts into `registry`."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._registry = registry
        self._server: WSGIServer | None = None
        self._thread: Thread | None = None
        self._tasks = Counter(
            "robot_tasks", "Tasks, by the site whose answer was used", ["kind", "site"], registry=registry
        )
        self._executions = Counter(
            "robot_executions",
            "Executions by site and outcome",
            ["kind", "site", "outcome"],
            registry=registry,
        )
        self._waited = Histogram(
            "robot_waited_seconds",
            "Seconds that the caller waited",
            ["kind"],
            buckets=SECONDS_BUCKETS,
            registry=registry,
        )
        self._predicted = Gauge(
            "robot_predicted_seconds", "Last prediction, in seconds", ["kind", "site"], registry=registry
        )
        self._interval = Counter(
            "robot_interval",
            "Answers, by whether their time was inside the 90 % interval of the prediction",
            ["kind", "site", "inside"],
            registry=registry,
        )
        self._decisions = Counter(
            "robot_decisions",
            "Tasks, by the site that was chosen",
            ["kind", "site", "policy"],
            registry=registry,
        )
        self._duplicates = Counter(
            "robot_duplicates",
            "Executions beyond the first of a task: warm-up, measuring, probes, hedges, fallbacks",
            ["kind"],
            registry=registry,
        )
        self._regret = {
            name: Gauge(f"robot_regret{name}_seconds", f"{what}, from probes", registry=registry)
            for name, what in REGRET.items()
        }

    def __call__(self, record: Record) -> None:
        self._tasks.labels(record.kind, record.used or "none").inc()
        self._waited.labels(record.kind).observe(record.waited_s)
        self._decisions.labels(record.kind, record.decision.site, record.decision.policy).inc()
        self._duplicates.labels(record.kind).inc(len(record.executions) - 1)
        for execution in record.executions:
            outcome = "ok" if execution.failure is None else type(execution.failure).__name__
            self._executions.labels(record.kind, execution.site, outcome).inc()
            self._judge(record, execution)
        for site, outlook in record.sites.items():
            if outlook.predicted_s is not None:
                self._predicted.labels(record.kind, site).set(outlook.predicted_s)

        if record.regret is not None:
            regret = record.regret
            for name, value in zip(REGRET, (regret.mean_s, regret.low_s, regret.high_s), strict=True):
                self._regret[name].set(value)

    def _judge(self, record: Record, execution: Execution) -> None:
        """Count whether the time was inside its interval. A run without an answer has no time to compare."""
        outlook = record.sites.get(execution.site)
        if not execution.ok or outlook is None or outlook.low_s is None or outlook.high_s is None:
            return
        inside = str(outlook.low_s <= execution.seconds <= outlook.high_s).lower()
        self._interval.labels(record.kind, execution.site, inside).inc()

    def watch(self, trace: Trace) -> None:
        """Also serve how many records `trace` has lost."""
        self._registry.register(_Lost(trace))

    def serve(self, host: str, port: int) -> None:
        """Answer GET /metrics in a background thread until `close`."""
        self._server, self._thread = start_http_server(port, host, registry=self._registry)
        log.info("metrics: http://%s:%d/metrics", host, self._server.server_port)

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()


class _Lost(Collector):
    """The records that a trace has lost by the time that Prometheus asks."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace

    def collect(self) -> Iterator[CounterMetricFamily]:
        yield CounterMetricFamily(
            "robot_trace_lost", "Records that the disk did not take in time", self._trace.lost
        )


def serve_metrics(address: str, where: str) -> Metrics:
    """Metrics that are served at HOST:PORT. A ConfigError, which begins with `where`, if that fails."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > PORT_MAX:
        raise ConfigError(f"{where}: {address!r} is not HOST:PORT with a port 0 to {PORT_MAX}")
    metrics = Metrics(CollectorRegistry())
    try:
        metrics.serve(host, int(port))
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"{where}: {address} cannot be served: {error}") from error
    return metrics
