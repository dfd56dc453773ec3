"""A stream whose calls are answered by the test, and whose thread never looks by itself."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from prometheus_client import CollectorRegistry

from offboard import task
from offboard.common.errors import CloudTimeout, ConfigError, OffloadError, TaskFailed
from offboard.robot_client.execution.call_future import CallFuture, chunk_of
from offboard.robot_client.records.record import ChunkRecord
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from offboard.robot_client.streams.action_stream import ActionStream
from offboard.robot_client.streams.asking import Pace
from offboard.robot_client.streams.counts import STREAMS_MAX, Counts, StreamMetrics
from offboard.testing import Bench
from tests.virtual import VirtualClock

PACE = Pace(hz=0.001, horizon=4)  # the thread looks once in 1,000 s


@task("kit_act", size=lambda number: number)
def kit_act(number: float) -> float:
    return number


class Caller:
    """Keeps the calls, which the test answers."""

    steps_itself = False

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.sites = {ONBOARD: 1.0, CLOUD: 0.0}
        self.calls: list[tuple[str, Any, CallFuture[Any]]] = []
        self.chunks: list[ChunkRecord | None] = []
        self.closed = False

    def able(self) -> dict[str, float]:
        return dict(self.sites)

    def call(self, item: Any, site: str, timeout_s: float, take: Any, *, useful_s: float) -> CallFuture[Any]:
        assert 0 < useful_s <= PACE.horizon_s
        assert timeout_s == PACE.horizon_s
        future = CallFuture[Any](falls_back=False)
        future.take = lambda answer: self.chunks.append(take(replace(answer, site=site)))
        self.calls.append((site, item, future))
        return future

    def quality(self, site: str) -> float:
        return 1.0 if site == CLOUD else 0.5

    def refuse(self) -> None:
        if self.closed:
            raise OffloadError("the offloader is closed")

    def take(self, site: str) -> CallFuture[Any]:
        """The oldest call of this site that was not answered."""
        return next(future for one, _, future in self.calls if one == site and not future.done())


def answer(future: CallFuture[Any], value: Any) -> None:
    future.keep(None)
    failure = value if isinstance(value, Exception) else None
    chunk_of(future, Execution("", 0.0, None if failure else value, failure=failure))
    if failure is not None:
        future.set_exception(failure)
    else:
        future.set_result(value)


@pytest.fixture
def caller() -> Caller:
    return Caller()


@pytest.fixture
def made() -> Iterator[list[ActionStream]]:
    streams: list[ActionStream] = []
    yield streams
    for stream in streams:
        stream.close()


def stream_of(caller: Caller, made: list[ActionStream], **options: Any) -> ActionStream:
    made.append(ActionStream("act", caller, PACE, **{"blend": 0, **options}))
    return made[-1]


def look(stream: ActionStream, observation: str) -> None:
    """The robot sees this, and the thread of the stream looks at the queue."""
    stream.see(observation)
    stream.look()


def actions(value: float) -> dict[str, Any]:
    return {"actions": np.full((4, 2), value)}


def test_the_newest_observation_is_played(caller: Caller, made: list[ActionStream]) -> None:
    """Both sites are asked at first; the answer that comes first is played, and the same one not again."""
    stream = stream_of(caller, made)
    look(stream, "seen")
    assert {(site, item) for site, item, _ in caller.calls} == {(ONBOARD, "seen"), (CLOUD, "seen")}
    answer(caller.take(CLOUD), actions(1.0))
    answer(caller.take(ONBOARD), actions(2.0))
    step = stream.next()
    assert step.action is not None
    assert (list(step.action), step.site, step.quality, step.held) == ([1.0, 1.0], CLOUD, 1.0, False)
    assert (stream.counts.late, stream.counts.played) == ({ONBOARD: 1}, {CLOUD: 1})


@pytest.mark.parametrize(
    ("on_empty", "before", "after"),
    [
        ("last", None, [1.0, 1.0]),
        ("zeros", None, [0.0, 0.0]),
        (lambda: np.full(2, 7.0), [7.0] * 2, [7.0] * 2),
    ],
)
def test_an_empty_queue_has_a_stand_in(
    caller: Caller, made: list[ActionStream], on_empty: Any, before: Any, after: Any
) -> None:
    """The last action, zeros, or what a function returns; before the first chunk, only the function knows."""
    stream = stream_of(caller, made, on_empty=on_empty)
    first = stream.next()
    assert (None if first.action is None else list(first.action), first.held) == (before, True)
    look(stream, "seen")
    answer(caller.take(CLOUD), actions(1.0))
    steps = [stream.next() for _ in range(5)]
    assert [step.held for step in steps] == [False] * 4 + [True]
    assert steps[-1].action is not None
    assert list(steps[-1].action) == after
    assert (stream.counts.steps, stream.counts.empty) == (6, 2)


def test_the_record_says_what_became_of_a_chunk(caller: Caller, made: list[ActionStream]) -> None:
    """When it was asked for, expected and there, how many steps were dropped, and the change at its seam."""
    stream = stream_of(caller, made)
    look(stream, "first")
    answer(caller.take(CLOUD), actions(1.0))
    answer(caller.take(ONBOARD), CloudTimeout("late"))
    played, lost = caller.chunks
    assert played == ChunkRecord(
        "played", PACE.hz, 0, 0, expected_s=None, arrived_s=0.0, left=0, actions=4, dropped=0
    )
    assert lost == ChunkRecord("lost", PACE.hz, 0, 0, expected_s=None, arrived_s=0.0, left=4)
    caller.clock.pass_by(2000.0)
    stream.next()
    look(stream, "second")
    caller.clock.pass_by(500.0)
    stream.next()
    answer(caller.take(CLOUD), actions(3.0))
    assert caller.chunks[-1] == ChunkRecord(
        "played", PACE.hz, 1, 1, expected_s=0.0, arrived_s=500.0, left=2, actions=4, dropped=1, seam=2.0
    )


def test_a_broken_runner_is_raised(made: list[ActionStream]) -> None:
    """An exception of a runner ends the thread of the stream; `next` raises it when the queue is empty."""

    class Broken(Caller):
        def able(self) -> dict[str, float]:
            raise ZeroDivisionError

    made.append(ActionStream("act", Broken(), Pace(hz=1000.0, horizon=4)))
    made[-1].see("seen")
    made[-1]._thread.join(5.0)
    with pytest.raises(ZeroDivisionError):
        made[-1].next()


def test_an_empty_queue_is_said_once_with_a_remedy(
    caller: Caller, made: list[ActionStream], caplog: pytest.LogCaptureFixture
) -> None:
    """However long it is empty."""
    stream = stream_of(caller, made)
    look(stream, "seen")
    answer(caller.take(CLOUD), actions(1.0))
    with caplog.at_level(logging.WARNING):
        for _ in range(20):
            stream.next()
    assert len(caplog.messages) == 1
    assert "no action is left at step 4" in caplog.text
    assert "remedy" in caplog.text


def test_reset_cancels_and_forgets(caller: Caller, made: list[ActionStream]) -> None:
    """An answer to a question of the old episode is not played, and the new one is asked for at once."""
    stream = stream_of(caller, made)
    look(stream, "old")
    stream.reset()
    assert all(future.cancelled() for _, _, future in caller.calls)
    assert stream.next().action is None
    caller.calls.clear()
    look(stream, "new")
    assert {item for _, item, _ in caller.calls} == {"new"}
    answer(caller.take(CLOUD), actions(3.0))
    step = stream.next()
    assert step.action is not None
    assert list(step.action) == [3.0, 3.0]


def test_an_error_of_onboard_waits_for_the_server(caller: Caller, made: list[ActionStream]) -> None:
    """`next` raises it once the queue is empty and no server is asked; a chunk makes it good."""
    stream = stream_of(caller, made)
    look(stream, "seen")
    answer(caller.take(ONBOARD), TaskFailed("broken"))
    assert stream.next().held
    answer(caller.take(CLOUD), CloudTimeout("late"))
    with pytest.raises(TaskFailed, match="broken"):
        stream.next()
    assert (stream.counts.failed, stream.counts.lost) == ({ONBOARD: 1}, {CLOUD: 1})


def test_a_closed_stream_has_cancelled_its_calls(caller: Caller, made: list[ActionStream]) -> None:
    """Its `next` says that it is closed, as does that of a closed offloader."""
    stream = stream_of(caller, made)
    look(stream, "seen")
    stream.close()
    assert all(future.cancelled() for _, _, future in caller.calls)
    with pytest.raises(OffloadError, match="the stream is closed"):
        stream.next()
    other = stream_of(caller, made)
    caller.closed = True
    with pytest.raises(OffloadError, match="the offloader is closed"):
        other.next()


def test_an_error_of_ask_is_raised_by_next(caller: Caller, made: list[ActionStream]) -> None:
    """It is the user's own function."""
    stream = stream_of(caller, made, ask=lambda *_: 1 / 0)
    look(stream, "seen")
    with pytest.raises(ZeroDivisionError):
        stream.next()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"blend": -1}, "blend -1: must be a whole number from 0"),
        ({"blend": 0.5}, "blend 0.5"),
        ({"on_empty": "first"}, "on_empty 'first': must be 'last', 'zeros' or a function"),
    ],
)
def test_bad_options_are_refused(caller: Caller, options: dict[str, Any], said: str) -> None:
    """The message names the option, its value and what is allowed."""
    with pytest.raises(ConfigError, match=said):
        ActionStream("act", caller, PACE, **options)


def test_a_call_of_a_stream_stays_on_its_site() -> None:
    """It fails with its site; the stream itself decides when onboard must start."""
    with Bench(onboard_s=0.2, cloud_s=0.05) as bench:
        bench.cloud.dead()
        options = (CLOUD, 1.5, None)
        with pytest.raises(CloudTimeout):
            bench.offload._call(kit_act, (1,), {}, options=options, caller=CallFuture(falls_back=False))
        assert [one.site for one in bench.records[-1].executions] == [CLOUD]


def test_metrics_are_the_sums_of_all_streams(caller: Caller, made: list[ActionStream]) -> None:
    """Those of streams that are long over count, too."""
    registry, metrics = CollectorRegistry(), StreamMetrics()
    registry.register(metrics)  # type: ignore[arg-type]
    stream = stream_of(caller, made)
    metrics.watch("act", stream.counts)
    look(stream, "seen")
    answer(caller.take(CLOUD), actions(1.0))
    for _ in range(5):
        stream.next()
    for _ in range(STREAMS_MAX + 10):
        metrics.watch("act", Counts(steps=1, empty=1))
    steps = {
        fresh: registry.get_sample_value("offboard_robot_stream_steps_total", {"kind": "act", "fresh": fresh})
        for fresh in ("true", "false")
    }
    assert steps == {"true": 4.0, "false": 1.0 + STREAMS_MAX + 10}
    labels = {"kind": "act", "site": CLOUD, "outcome": "played"}
    assert registry.get_sample_value("offboard_robot_stream_chunks_total", labels) == 1.0
