"""Calls with a deadline, and calls whose future is returned at once."""

import asyncio
import contextlib
import itertools
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from offboard import Settings
from offboard.common.errors import ConfigError, DeadlineMissed, TaskFailed
from offboard.common.tasks import task
from offboard.robot_client import predictors
from offboard.robot_client.lifetime import ASYNC_CALLS_MAX
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing import Bench

WAIT_S = 20.0  # longer than any step of a test takes on a busy machine
SHORT_S = 0.05
HELD = 1  # the number of a task that waits for the test

go_on = threading.Event()
ran: list[int] = []


@task("deadline_echo", size=lambda number: abs(number))
def deadline_echo(number: int) -> int:
    ran.append(number)
    if number < 0:
        raise ValueError("negative")
    if number == HELD:
        go_on.wait(WAIT_S)
    return number


@task("deadline_nested", size=lambda number: number)
def deadline_nested(number: int) -> int:
    return present[-1](deadline_echo, number, deadline_s=WAIT_S)


present: list[Offloader] = []  # the one of the test that runs


@pytest.fixture
def records() -> "queue.SimpleQueue[Record]":
    return queue.SimpleQueue()


@pytest.fixture
def offload(records: "queue.SimpleQueue[Record]") -> Iterator[Offloader]:
    go_on.clear()
    ran.clear()
    with Offloader.connect(observers=[records.put]) as made:
        present.append(made)
        yield made
        go_on.set()


@pytest.mark.parametrize("seconds", [np.float32(2.5), np.float64(2.5), np.int64(2), 2, Fraction(5, 2)])
def test_a_deadline_may_be_any_real_number(
    offload: Offloader, records: "queue.SimpleQueue[Record]", seconds: float
) -> None:
    """Numbers of NumPy work as a float does, for `timeout_s` too; the record has a float."""
    assert offload(deadline_echo, 5, deadline_s=seconds, timeout_s=seconds) == 5
    record = records.get(timeout=WAIT_S)
    assert record.deadline_s == float(seconds)
    assert type(record.deadline_s) is float
    assert type(record.timeout_s) is float
    outlook = offload.expect(deadline_echo, 5, deadline_s=seconds)[ONBOARD]
    assert outlook == offload.expect(deadline_echo, 5, deadline_s=float(seconds))[ONBOARD]


@pytest.mark.parametrize(
    "seconds", [True, np.True_, Decimal("2.5"), np.array(2.5), np.array([2.5]), np.ones(3), 1j, "2", [2.5]]
)
def test_what_is_no_real_number_is_refused_at_once(offload: Offloader, seconds: Any) -> None:
    """It is one ConfigError that names the option, before the task runs."""
    for name in ("deadline_s", "timeout_s"):
        with pytest.raises(ConfigError, match=f"^{name} .*: must be a number above 0, at most 86400$"):
            offload(deadline_echo, 5, **{name: seconds})
    with pytest.raises(ConfigError, match=r"^deadline_s "):
        offload.expect(deadline_echo, 5, deadline_s=seconds)
    with pytest.raises(ConfigError, match=r"^timeout_s "):
        offload.map(deadline_echo, [5], timeout_s=seconds)
    with pytest.raises(ConfigError, match=r"^timeout_s "):
        Offloader.connect(timeout_s=seconds)
    with pytest.raises(ConfigError, match=r"^deadline_s "):
        offload.submit(deadline_echo, 5, deadline_s=seconds).result(WAIT_S)
    assert not ran


def test_an_answer_in_time_is_returned(offload: Offloader, records: "queue.SimpleQueue[Record]") -> None:
    """It is the answer of a call without a deadline, and its record names the deadline."""
    assert offload(deadline_echo, 5, deadline_s=WAIT_S) == 5
    record = records.get(timeout=WAIT_S)
    assert (record.deadline_s, record.used) == (WAIT_S, ONBOARD)
    assert offload(deadline_echo, 6) == 6
    assert records.get(timeout=WAIT_S).deadline_s is None


def test_a_late_call_raises_with_what_was_expected_and_teaches(
    offload: Offloader, records: "queue.SimpleQueue[Record]"
) -> None:
    """The caller goes on at the deadline; the task runs to its end, is recorded, and its time is learnt."""
    for _ in range(3):
        offload(deadline_echo, 2)
        records.get(timeout=WAIT_S)
    began_s = time.monotonic()
    with pytest.raises(
        DeadlineMissed, match=r"task deadline_echo: no answer within 0\.05 s; expected: onboard"
    ) as missed:
        offload(deadline_echo, HELD, deadline_s=SHORT_S)
    waited_s = time.monotonic() - began_s
    print(f"waited {waited_s:.3f} s")
    assert SHORT_S <= waited_s < WAIT_S / 2
    expected = missed.value.expected[ONBOARD]
    assert expected.seconds is not None
    assert expected.seconds < SHORT_S
    assert records.empty()
    go_on.set()
    record = records.get(timeout=WAIT_S)
    assert record.deadline_s == SHORT_S
    assert record.waited_s > SHORT_S
    assert offload(deadline_echo, 3) == 3
    assert records.get(timeout=WAIT_S).sites[ONBOARD].observations == 4


def test_a_failure_of_the_task_comes_before_its_deadline(offload: Offloader) -> None:
    """A task that raises in time raises TaskFailed, as in any other call."""
    with pytest.raises(TaskFailed, match="ValueError: negative"):
        offload(deadline_echo, -2, deadline_s=WAIT_S)


def test_a_call_that_has_not_begun_by_its_deadline_is_dropped(offload: Offloader) -> None:
    """If late runs hold all threads, a further call misses its deadline, and its task never runs."""
    with ThreadPoolExecutor(ASYNC_CALLS_MAX) as pool:
        late = [pool.submit(offload, deadline_echo, HELD, deadline_s=1.0) for _ in range(ASYNC_CALLS_MAX)]
        assert {type(one.exception()) for one in late} == {DeadlineMissed}
    with pytest.raises(DeadlineMissed):
        offload(deadline_echo, 7, deadline_s=SHORT_S)
    go_on.set()
    assert offload(deadline_echo, 8, deadline_s=WAIT_S) == 8
    assert 7 not in ran


def test_a_call_runs_although_its_thread_begins_after_the_deadline(
    offload: Offloader, records: "queue.SimpleQueue[Record]"
) -> None:
    """A deadline that has passed when the thread begins does not keep the task from running and teaching."""
    for number in range(2, 202):
        with contextlib.suppress(DeadlineMissed):
            offload(deadline_echo, number, deadline_s=1e-9)
        assert records.get(timeout=WAIT_S).used == ONBOARD
    assert len(ran) == 200


def test_a_deadline_prefers_the_site_that_misses_it_least() -> None:
    """The cloud is faster in the mean, but misses more often; only the call with a deadline stays onboard."""
    took_s = itertools.cycle([0.02] * 4 + [0.3])
    settings = Settings(predictor=predictors.LEAST_SQUARES)
    with Bench(onboard_s=0.1, cloud_s=lambda _: next(took_s), policy="greedy", settings=settings) as bench:
        for number in range(100):
            bench.offload(deadline_echo, 3, where=(ONBOARD, CLOUD)[number % 2])
        bench.offload(deadline_echo, 3)
        assert bench.records[-1].decision.site == CLOUD
        bench.offload(deadline_echo, 3, deadline_s=0.2)
        assert bench.records[-1].decision.site == ONBOARD
        chances = bench.offload.expect(deadline_echo, 3, deadline_s=0.2)
    print({site: one.in_time for site, one in chances.items()})
    assert chances[CLOUD].in_time == pytest.approx(0.8, abs=0.1)
    assert chances[ONBOARD].in_time == pytest.approx(1.0, abs=0.03)


STUCK = """
import threading
from offboard import DeadlineMissed, Offloader, task
from offboard.robot_client.sites import onboard

onboard.CLOSE_WAIT_S = 0.05


@task("stuck", size=float)
def stuck(number):
    threading.Event().wait()


with Offloader.connect() as offload:
    try:
        offload(stuck, 1, deadline_s=0.05)
    except DeadlineMissed as missed:
        print(missed)
"""


def test_a_task_that_never_ends_does_not_keep_the_process() -> None:
    """The program goes on at the deadline, and its process ends after the close."""
    done = subprocess.run(
        [sys.executable, "-c", STUCK], capture_output=True, text=True, timeout=WAIT_S, check=True
    )
    assert done.stdout == "task stuck: no answer within 0.05 s; expected: onboard unknown\n"


def test_a_task_may_call_with_a_deadline(offload: Offloader) -> None:
    """The inner call runs onboard in a thread of its own, while the task waits for it."""
    assert offload(deadline_nested, 4) == 4
    assert offload(deadline_nested, 5, deadline_s=WAIT_S) == 5


def test_submit_returns_at_once(offload: Offloader) -> None:
    """The future gets the answer, or the failure of the task."""
    held = offload.submit(deadline_echo, HELD)
    assert not held.done()
    go_on.set()
    assert held.result(WAIT_S) == HELD
    with pytest.raises(TaskFailed, match="negative"):
        offload.submit(deadline_echo, -1, where=ONBOARD).result(WAIT_S)


def test_a_submitted_call_that_waits_can_be_cancelled(offload: Offloader) -> None:
    """Calls beyond ASYNC_CALLS_MAX wait; such a call is dropped, and the others are answered."""
    begun = [offload.submit(deadline_echo, HELD) for _ in range(ASYNC_CALLS_MAX)]
    waiting = offload.submit(deadline_echo, 9)
    assert waiting.cancel()
    go_on.set()
    assert [one.result(WAIT_S) for one in begun] == [HELD] * ASYNC_CALLS_MAX
    assert 9 not in ran


def test_more_submitted_deadlines_than_threads_are_all_met(offload: Offloader) -> None:
    """Calls that wait for their deadline hold no thread that their tasks need."""
    count = 2 * ASYNC_CALLS_MAX
    calls = [offload.submit(deadline_echo, number, deadline_s=WAIT_S) for number in range(2, 2 + count)]
    assert [one.result(WAIT_S) for one in calls] == list(range(2, 2 + count))


def test_a_deadline_holds_in_asyncio(offload: Offloader) -> None:
    """`await offload.run(..., deadline_s=...)` raises DeadlineMissed too."""
    with pytest.raises(DeadlineMissed):
        asyncio.run(offload.run(deadline_echo, HELD, deadline_s=SHORT_S))
