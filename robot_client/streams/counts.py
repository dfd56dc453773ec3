"""What streams have done, for programs and for Prometheus."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily

STREAMS_MAX = 64  # that are counted one by one; of older ones only the sum is kept
OUTCOMES = ("played", "late", "lost", "refused", "failed")


@dataclass(slots=True)
class Counts:
    """What a stream has done so far; chunks by site.

    empty: steps without a fresh action. age_s: the ages of the other ones together.
    asked: the questions. played: chunks of which actions were played. late: chunks that were dropped whole,
    as they came too late or from an older observation than the one that was played. lost: chunks that had
    not come when all of their steps had passed. refused: answers that are no actions. failed: other failures.
    """

    steps: int = 0
    empty: int = 0
    age_s: float = 0.0
    asked: Counter[str] = field(default_factory=Counter)
    played: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    failed: Counter[str] = field(default_factory=Counter)

    def add(self, other: "Counts") -> None:
        """Count what the other one has counted, too."""
        self.steps += other.steps
        self.empty += other.empty
        self.age_s += other.age_s
        for name in ("asked", *OUTCOMES):
            getattr(self, name).update(dict(getattr(other, name)))


class StreamMetrics:
    """The counts of all streams of an offloader, by kind, at the time when Prometheus asks: a collector."""

    def __init__(self) -> None:
        self._streams: deque[tuple[str, Counts]] = deque()
        self._before: dict[str, Counts] = {}  # the sums of streams that are left out

    def watch(self, kind: str, counts: Counts) -> None:
        """Count this stream from now on."""
        self._streams.append((kind, counts))
        if len(self._streams) > STREAMS_MAX:
            oldest, last = self._streams.popleft()
            self._before.setdefault(oldest, Counts()).add(last)

    def collect(self) -> "Iterator[CounterMetricFamily]":
        from prometheus_client.core import CounterMetricFamily  # only where metrics are served

        totals: dict[str, Counts] = {}
        for kind, counts in [*self._before.items(), *self._streams]:
            totals.setdefault(kind, Counts()).add(counts)
        about = "Steps of streams, by whether they had a fresh action"
        steps = CounterMetricFamily("offboard_robot_stream_steps", about, labels=["kind", "fresh"])
        about = "Ages of all fresh actions together, in seconds"
        ages = CounterMetricFamily("offboard_robot_stream_age_seconds", about, labels=["kind"])
        about = "Chunks of streams, by site and by what became of them"
        chunks = CounterMetricFamily(
            "offboard_robot_stream_chunks", about, labels=["kind", "site", "outcome"]
        )
        for kind, counts in totals.items():
            steps.add_metric([kind, "true"], counts.steps - counts.empty)
            steps.add_metric([kind, "false"], counts.empty)
            ages.add_metric([kind], counts.age_s)
            for outcome in OUTCOMES:
                for site, count in getattr(counts, outcome).items():
                    chunks.add_metric([kind, site, outcome], count)
        yield from (steps, ages, chunks)
