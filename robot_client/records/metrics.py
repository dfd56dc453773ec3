"""The Prometheus metrics of the robot, updated with the record of every task.

The records are made in `offloader`.
"""

import logging
from collections.abc import Iterator
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from offboard.common.live.live_port import LivePort
from offboard.common.live.look import RobotLive
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import Execution

SECONDS_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)

GONE_MAX = 16  # servers that have left, of which metrics are kept

log = logging.getLogger(__name__)


class Metrics:
    """An observer of the offloader that counts into `registry`, and keeps records for the page /live.

    Of a server that has left, the metrics stay until GONE_MAX others have left after it.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        r = self._registry = registry
        self._port: LivePort | None = None
        self.live = RobotLive(as_dict)
        site = ["kind", "site"]
        about = "Tasks, by the site whose answer was used"
        self._tasks = _ByLabels(Counter("offboard_robot_tasks", about, site, registry=r))
        about, labels = "Executions by site and outcome", [*site, "outcome"]
        self._executions = _ByLabels(Counter("offboard_robot_executions", about, labels, registry=r))
        about, name = "Seconds that the caller waited", "offboard_robot_wait_seconds"
        self._waited = _ByLabels(Histogram(name, about, ["kind"], buckets=SECONDS_BUCKETS, registry=r))
        about = "Last prediction, in seconds"
        self._predicted = _ByLabels(Gauge("offboard_robot_predicted_seconds", about, site, registry=r))
        about = "Answers, by whether their time was inside the 90 % interval of the prediction"
        labels = [*site, "inside"]
        self._interval = _ByLabels(Counter("offboard_robot_interval_checks", about, labels, registry=r))
        about, labels = "Tasks, by the site that was chosen", [*site, "policy"]
        self._decisions = _ByLabels(Counter("offboard_robot_decisions", about, labels, registry=r))
        about = "Executions beyond the first of a task: warm-up, measuring, probes, hedges, fallbacks"
        name = "offboard_robot_duplicate_executions"
        self._duplicates = _ByLabels(Counter(name, about, ["kind"], registry=r))
        about, name = "Calls without an answer by their deadline", "offboard_robot_missed_deadlines"
        self._missed = _ByLabels(Counter(name, about, ["kind"], registry=r))
        about = "Calls that their program cancelled after they had begun"
        self._cancelled = _ByLabels(Counter("offboard_robot_cancelled_calls", about, ["kind"], registry=r))
        about = "1 if the last task of this kind could use the site; 0 if it was silent or absent"
        self._usable = _ByLabels(Gauge("offboard_robot_site_usable", about, site, registry=r))
        counted = self._tasks, self._executions, self._interval, self._decisions
        self._by_site = (*counted, self._predicted, self._usable)
        self._sites: set[str] = set()  # of the last record
        self._gone: dict[str, None] = {}  # the oldest first
        self._regret = _LatestRegret()
        registry.register(self._regret)

    def __call__(self, record: Record) -> None:
        if record.started_at >= self.live.due_at:
            self.live.keep(record, record.started_at)
        if record.cancelled:
            self._cancelled[record.kind,].inc()
        else:
            self._tasks[record.kind, record.used or "none"].inc()
            self._missed[record.kind,].inc(record.missed_deadline)
        self._waited[record.kind,].observe(record.waited_s)
        self._decisions[record.kind, record.decision.site, record.decision.policy].inc()
        self._duplicates[record.kind,].inc(len(record.executions) - 1)
        for execution in record.executions:
            outcome = "ok" if execution.failure is None else type(execution.failure).__name__
            self._executions[record.kind, execution.site, outcome].inc()
            self._judge(record, execution)
        for site, outlook in record.sites.items():
            if outlook.predicted_s is not None:
                self._predicted[record.kind, site].set(outlook.predicted_s)
        sites = {*self.live.sites, *record.sites}  # a server that never answered is shown too
        for site in sites:
            found = record.sites.get(site)
            self._usable[record.kind, site].set(found is not None and not found.condition.silent)
        sites.update(execution.site for execution in record.executions)
        if sites != self._sites:
            self._change(sites)
        if record.regret is not None:
            self._regret.latest = record.regret

    def _change(self, sites: set[str]) -> None:
        """The sites are these from now on."""
        for site in self._sites - sites:
            self._gone[site] = None
        for site in sites:
            self._gone.pop(site, None)
        self._sites = sites
        for labels in self._usable:
            if labels[1] in self._gone:
                self._usable[labels].set(0)
        while len(self._gone) > GONE_MAX:
            oldest = next(iter(self._gone))
            del self._gone[oldest]
            for metric in self._by_site:
                metric.forget(oldest)

    def _judge(self, record: Record, execution: Execution) -> None:
        """Count whether the time was inside its interval. A run without an answer has no time to compare."""
        outlook = record.sites.get(execution.site)
        if not execution.ok or outlook is None or outlook.low_s is None or outlook.high_s is None:
            return
        inside = str(outlook.low_s <= execution.seconds <= outlook.high_s).lower()
        self._interval[record.kind, execution.site, inside].inc()

    def watch(self, trace: Trace) -> None:
        """Also serve how many records `trace` has lost."""
        self.show(_Lost(trace))

    def show(self, collector: Any) -> None:
        """Also serve the metrics that `collect` of this object yields."""
        self._registry.register(collector)

    def serve(self, address: str, where: str) -> None:
        """Answer GET /metrics and /live in background threads until `close`."""
        self._port = LivePort(address, where, source=self.live, registry=self._registry)
        log.info("metrics: %s/metrics; live page: %s/live", self._port.url, self._port.url)

    def close(self) -> None:
        """Stop serving."""
        if self._port is not None:
            self._port.close()


class _ByLabels(dict[tuple[str, ...], Any]):
    """The metrics of a family by their labels. To find one there takes most of the time of counting."""

    def __init__(self, family: Any) -> None:
        self._family = family

    def __missing__(self, labels: tuple[str, ...]) -> Any:
        found = self[labels] = self._family.labels(*labels)
        return found

    def forget(self, site: str) -> None:
        """Remove the metrics of this site. Their labels begin with the kind and the site."""
        for labels in [one for one in self if one[1] == site]:
            del self[labels]
            self._family.remove(*labels)


class _Lost(Collector):
    """The records that a trace has lost by the time that Prometheus asks."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace

    def collect(self) -> Iterator[CounterMetricFamily]:
        yield CounterMetricFamily(
            "offboard_robot_trace_lost_records",
            "Records that the disk did not take in time",
            self._trace.lost,
        )


class _LatestRegret(Collector):
    """The newest estimate. Before the first one there is no metric, as 0 would mean that nothing was lost."""

    latest: Regret | None = None

    def collect(self) -> Iterator[GaugeMetricFamily]:
        name = "offboard_robot_regret{}_seconds"
        if (found := self.latest) is not None:
            what = "Mean seconds per task that the better site would have saved, estimated from probes"
            yield GaugeMetricFamily(name.format(""), what, found.mean_s)
            for end, value in (("low", found.low_s), ("high", found.high_s)):
                yield GaugeMetricFamily(name.format(f"_{end}"), f"The {end} end of its 90 % interval", value)


def serve_metrics(address: str, where: str) -> Metrics:
    """Metrics that are served at HOST:PORT. A ConfigError, which begins with `where`, if that fails."""
    metrics = Metrics(CollectorRegistry())
    metrics.serve(address, where)
    return metrics
