"""Prometheus metrics of the robot, fed by the record of every task."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server

from robot_client.trace import Record

SECONDS_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


class Metrics:
    """An observer for the offloader; counts into `registry`."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._registry = registry
        self._tasks = Counter(
            "robot_tasks", "Tasks answered, by the site used", ["kind", "site"], registry=registry
        )
        self._executions = Counter(
            "robot_executions",
            "Executions by site and outcome",
            ["kind", "site", "outcome"],
            registry=registry,
        )
        self._waited = Histogram(
            "robot_waited_seconds",
            "What the caller waited",
            ["kind"],
            buckets=SECONDS_BUCKETS,
            registry=registry,
        )
        self._predicted = Gauge(
            "robot_predicted_seconds", "Last prediction", ["kind", "site"], registry=registry
        )

    def __call__(self, record: Record) -> None:
        self._tasks.labels(record.kind, record.used or "none").inc()
        self._waited.labels(record.kind).observe(record.waited_s)
        for execution in record.executions:
            outcome = "ok" if execution.failure is None else type(execution.failure).__name__
            self._executions.labels(record.kind, execution.site, outcome).inc()
        for site, outlook in record.sites.items():
            if outlook.predicted_s is not None:
                self._predicted.labels(record.kind, site).set(outlook.predicted_s)

    def serve(self, host: str, port: int) -> None:
        """Answer GET /metrics from a thread of its own."""
        start_http_server(port, host, registry=self._registry)
