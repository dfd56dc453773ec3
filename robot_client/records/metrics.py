"""The Prometheus metrics of the robot, updated with the record of every task.

The records are made in `offloader`.
"""

import logging
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from offboard.common.live.live_port import LivePort
from offboard.common.live.robot_live import RobotLive
from offboard.robot_client.records.trace import Record, Trace, as_dict
from offboard.robot_client.sites.runner import Execution

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
        self._port: LivePort | None = None
        self.live = RobotLive(as_dict)
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
        self.live.keep(record)
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

    def serve(self, address: str, where: str) -> None:
        """Answer GET /metrics and /live in background threads until `close`."""
        self._port = LivePort(address, where, source=self.live, registry=self._registry)
        log.info("metrics: %s/metrics; live page: %s/live", self._port.url, self._port.url)

    def close(self) -> None:
        """Stop serving."""
        if self._port is not None:
            self._port.close()


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
    metrics = Metrics(CollectorRegistry())
    metrics.serve(address, where)
    return metrics
