"""The robot's metrics."""

from dataclasses import replace

from prometheus_client import CollectorRegistry

from robot_client.metrics import Metrics
from robot_client.runner import CLOUD, ONBOARD
from tests.unit.test_trace import record


def test_a_record_is_counted_once_by_site_and_outcome() -> None:
    """A task that the cloud lost and onboard answered is one task, two executions and one wait."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    observe(record(0))
    observe(replace(record(1), used=None))

    def value(name: str, **labels: str) -> float | None:
        return registry.get_sample_value(name, {"kind": "plan_path", **labels})

    assert value("robot_tasks_total", site=ONBOARD) == 1
    assert value("robot_tasks_total", site="none") == 1
    assert value("robot_executions_total", site=CLOUD, outcome="CloudTimeout") == 2
    assert value("robot_executions_total", site=ONBOARD, outcome="ok") == 2
    assert value("robot_waited_seconds_sum") == 4.2
    assert value("robot_predicted_seconds", site=ONBOARD) == 0.1
    assert value("robot_predicted_seconds", site=CLOUD) is None
