"""The test kit `offboard.testing`: what each scripted site does, and virtual time with several threads."""

import asyncio
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from offboard import ConfigError, DeadlineMissed, OffloadError, TaskFailed, check_wanted, task
from offboard.common.errors import CloudBroken, CloudTimeout
from offboard.common.tasks import kind_of
from offboard.robot_client.lifetime import ASYNC_CALLS_MAX
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.heartbeat import EVERY_S
from offboard.robot_client.sites.outgoing import new_task
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S
from offboard.testing import Bench, SharedClock, shared_clock

ONBOARD_S, CLOUD_S = 0.2, 0.05
KNOWN = 20  # calls after which each site is known
LATE_CALL_S = 0.3  # a call that is answered onboard once the cloud is late


@task("kit_double", size=lambda number: number)
def double(number: float) -> float:
    return 2 * number


@task("kit_once", size=lambda: 0.0, duplicate=False)
def once() -> str:
    return "done"


@task("kit_raise", size=lambda: 0.0)
def raise_error() -> None:
    raise ValueError("no such frame")


@task("kit_types", size=lambda *_: 0.0)
def types_of(pair: Any, array: Any) -> dict[str, Any]:
    return {"pair": type(pair).__name__, "writeable": bool(array.flags.writeable), "back": pair}


@task("kit_set", size=lambda *_: 0.0)
def set_of(values: list[int]) -> set[int]:
    return set(values)


@pytest.fixture
def bench() -> Any:
    with Bench(onboard_s=ONBOARD_S, cloud_s=CLOUD_S) as made:
        yield made


def calls(bench: Bench, count: int) -> Sequence[Record]:
    """The records of this many calls, which are all answered rightly."""
    for number in range(count):
        assert bench.offload(double, number) == 2 * number
    return bench.records[-count:]


def used(records: Sequence[Record]) -> set[str | None]:
    return {one.used for one in records}


def test_times_are_those_of_the_test(bench: Bench) -> None:
    """A call takes the seconds of its site; its record and the clock tell virtual time."""
    for where, seconds in ((CLOUD, CLOUD_S), (ONBOARD, ONBOARD_S)):
        began_s = bench.clock.now_s()
        assert bench.offload(double, 4, where=where) == 8
        assert bench.records[-1].waited_s == pytest.approx(seconds)
        assert bench.clock.now_s() - began_s == pytest.approx(seconds)
        assert bench.records[-1].executions[0].seconds == pytest.approx(seconds)


def test_the_offloader_learns_the_faster_site(bench: Bench) -> None:
    """After the warm-up the default uses the cloud alone, and predicts its time."""
    last = calls(bench, KNOWN)[-1]
    assert (last.used, last.decision.site, len(last.executions)) == (CLOUD, CLOUD, 1)
    assert last.sites[CLOUD].predicted_s == pytest.approx(CLOUD_S, rel=0.05)
    assert last.sites[CLOUD].condition.round_trip_s == pytest.approx(bench.cloud.round_trip_s)


def test_a_slow_site_is_left(bench: Bench) -> None:
    """A cloud that has become ten times slower loses the tasks to onboard; a slow onboard loses them, too."""
    calls(bench, KNOWN)
    bench.cloud.slow(1.0)
    assert used(calls(bench, KNOWN)[7:]) == {ONBOARD}
    bench.onboard.slow(3.0)
    records = calls(bench, KNOWN)
    assert used(records[5:]) == {CLOUD}
    assert records[-1].waited_s == pytest.approx(1.0)


def test_a_dead_site_costs_one_late_call(bench: Bench) -> None:
    """The call under way is hedged; the next ones run onboard at once, because heartbeats are unanswered."""
    calls(bench, KNOWN)
    bench.cloud.dead()
    first, *others = calls(bench, KNOWN)
    assert [one.site for one in first.executions] == [CLOUD, ONBOARD]
    assert ONBOARD_S < first.waited_s < LATE_CALL_S
    assert [one.waited_s for one in others] == pytest.approx([ONBOARD_S] * len(others))
    assert others[-1].sites[CLOUD].condition.silent


def test_a_dead_site_is_used_again_when_it_is_back(bench: Bench) -> None:
    """What it missed arrives, so the next heartbeat is answered, and tasks go there within a second."""
    calls(bench, KNOWN)
    bench.cloud.dead()
    calls(bench, KNOWN)
    bench.cloud.back()
    bench.clock.pass_by(2 * EVERY_S)
    assert used(calls(bench, KNOWN)) == {CLOUD}


def test_a_call_that_is_pinned_to_a_dead_site_falls_back(bench: Bench) -> None:
    """After its timeout onboard answers; a task that must not run twice raises CloudTimeout."""
    bench.cloud.dead()
    assert bench.offload(double, 1, where=CLOUD, timeout_s=1.5) == 2
    assert bench.records[-1].waited_s == pytest.approx(1.5 + ONBOARD_S)
    began_s = bench.clock.now_s()
    with pytest.raises(CloudTimeout):
        bench.offload(once, where=CLOUD)
    assert bench.clock.now_s() - began_s == pytest.approx(TIMEOUT_S)


def test_a_link_that_dies_during_a_call_holds_its_answer(bench: Bench) -> None:
    """An event at a time of the test happens while the call waits."""
    calls(bench, KNOWN)
    bench.clock.after(CLOUD_S / 2, bench.cloud.dead)
    (record,) = calls(bench, 1)
    assert record.used == ONBOARD
    assert record.waited_s < LATE_CALL_S


def test_a_lost_connection_fails_runs_at_once(bench: Bench) -> None:
    """The run under way is CloudBroken, calls run onboard, and nobody waits for the site in vain."""
    calls(bench, KNOWN)
    bench.clock.pass_by(1.0)  # onboard ends what it has
    bench.clock.after(CLOUD_S / 2, bench.cloud.gone)
    assert bench.offload(double, 1, where=CLOUD) == 2
    assert isinstance(bench.records[-1].executions[0].failure, CloudBroken)
    assert bench.records[-1].waited_s == pytest.approx(CLOUD_S / 2 + ONBOARD_S)
    (record,) = calls(bench, 1)
    assert record.decision.reason == "cloud: not connected"
    assert bench.offload.wait_for_sites(double, 60.0) == {CLOUD: "not connected"}
    assert not bench.offload.sites[CLOUD].connected
    bench.cloud.back()
    assert bench.offload.wait_for_sites(double, 60.0) == {}
    assert [one.what for one in bench.offload.sites[CLOUD].story][-3:] == ["down", "fail", "up"]
    assert used(calls(bench, 3)) == {CLOUD}


def test_late_answers_count_as_timeouts(bench: Bench) -> None:
    """No answer comes within the timeout, heartbeats are answered, and onboard answers each call."""
    calls(bench, KNOWN)
    bench.cloud.late()
    records = calls(bench, KNOWN)
    assert used(records) == {ONBOARD}
    assert not any(one.sites[CLOUD].condition.silent for one in records)
    assert bench.offload(double, 1, where=CLOUD) == 2
    assert isinstance(bench.records[-1].executions[0].failure, CloudTimeout)
    bench.cloud.back()
    assert bench.offload(double, 1, where=CLOUD) == 2
    assert bench.records[-1].used == CLOUD


def test_a_lying_site_returns_a_wrong_value(bench: Bench) -> None:
    """It is the value of the test, or made from the right one, until the site is back."""
    for wrong, answer in ((-1, -1), (lambda right: right + 0.5, 6.5), (lambda _: "text", "text")):
        bench.cloud.lie(wrong)
        assert bench.offload(double, 3, where=CLOUD) == answer
        assert bench.offload(double, 3, where=ONBOARD) == 6
    bench.cloud.back()
    assert bench.offload(double, 3, where=CLOUD) == 6


@pytest.mark.parametrize("where", [CLOUD, ONBOARD, None])
def test_a_function_that_raises_fails_as_everywhere(bench: Bench, where: str | None) -> None:
    """The caller gets TaskFailed with the traceback, and onboard with its cause."""
    with pytest.raises(TaskFailed, match=r"^task kit_raise: ValueError: no such frame$") as failed:
        bench.offload(raise_error, where=where)
    assert "in raise_error" in failed.value.traceback
    if where == ONBOARD:
        assert isinstance(failed.value.__cause__, ValueError)


def test_values_cross_the_link(bench: Bench) -> None:
    """In the cloud tuples are lists and arrays read-only; what cannot be sent is answered onboard."""
    assert bench.offload(types_of, (1, 2), np.zeros(3), where=CLOUD) == {
        "pair": "list",
        "writeable": False,
        "back": [1, 2],
    }
    assert bench.records[-1].executions[0].bytes_out > 3 * 8
    assert bench.offload(types_of, (1, 2), np.zeros(3), where=ONBOARD)["pair"] == "tuple"
    assert bench.offload(set_of, [1, 2], where=CLOUD) == {1, 2}
    assert bench.offload(types_of, {1}, np.zeros(3), where=CLOUD)["pair"] == "set"
    refused = bench.records[-1].executions
    assert [(one.site, one.started) for one in refused] == [(CLOUD, False), (ONBOARD, True)]
    said = "CannotCross: arguments[0]: a value of type builtins.set cannot be sent"
    assert str(refused[0].error).startswith(said)


@dataclass(frozen=True)
class Point:
    x: float


@task("kit_packed", size=lambda *_: 0.0, types=(Point,), pack=lambda p: p.x, unpack=lambda x: Point(x + 1))
def packed(point: Point) -> Point:
    return point


def test_packing_runs_on_the_way_to_a_server(bench: Bench) -> None:
    """`pack` and `unpack` run for the cloud, and not onboard."""
    assert bench.offload(packed, Point(1.0), where=CLOUD) == Point(2.0)
    assert bench.offload(packed, Point(1.0), where=ONBOARD) == Point(1.0)


@dataclass
class Setup:
    made: int = 0
    fails: bool = False

    def __call__(self) -> int:
        self.made += 1
        if self.fails:
            raise OSError("no model")
        return 10


setup = Setup()


@task("kit_model", size=lambda number: number, setup=lambda: setup())
def with_model(model: int, number: int) -> int:
    return model + number


def test_each_site_has_its_setup_once(bench: Bench) -> None:
    """Its state comes before the arguments; if it raises, the call raises TaskFailed."""
    setup.__init__()  # type: ignore[misc]
    for _ in range(3):
        assert bench.offload(with_model, 1, where="both") == 11
    assert setup.made == 2
    with Bench() as other:
        setup.fails = True
        with pytest.raises(TaskFailed, match="setup of task kit_model: OSError: no model"):
            other.offload(with_model, 1)
    setup.__init__()  # type: ignore[misc]


def test_two_servers_have_scripts_of_their_own() -> None:
    """The faster one is used until it dies, and then the other one."""
    with Bench(onboard_s=0.5, cloud_s=0.1, sites={"edge": 0.03}) as bench:
        assert used(calls(bench, 3 * KNOWN)[KNOWN:]) == {"edge"}
        bench.sites["edge"].dead()
        records = calls(bench, KNOWN)
        assert used(records[1:]) == {CLOUD}
        bench.cloud.gone()
        assert used(calls(bench, KNOWN)) == {ONBOARD}


def test_seconds_may_depend_on_the_arguments() -> None:
    """A function of the arguments says how long each task takes."""
    with Bench(onboard_s=lambda number: 0.01 * number) as bench:
        for number in (1, 7):
            bench.offload(double, number, where=ONBOARD)
            assert bench.records[-1].waited_s == pytest.approx(0.01 * number)


def test_onboard_runs_one_task_at_a_time(bench: Bench) -> None:
    """Tasks wait for the one that runs, in the order in which they came; a cancelled one makes room."""
    tasks = [new_task(kind_of(double), (float(number),)) for number in range(4)]
    runs = [bench.onboard.submit(one, TIMEOUT_S).result for one in tasks]
    bench.onboard.cancel(tasks[1])
    bench.clock.pass_by(1.5 * ONBOARD_S)
    bench.onboard.cancel(tasks[2])
    bench.clock.pass_by(ONBOARD_S)
    ended = [run(0) for run in runs]
    assert [one.value for one in ended] == [0, None, None, 6]
    assert [one.started for one in ended] == [True, False, True, True]
    assert [one.seconds for one in ended] == pytest.approx([ONBOARD_S, 0.0, 1.5 * ONBOARD_S, 2.5 * ONBOARD_S])
    assert ended[3].queue_s == pytest.approx(1.5 * ONBOARD_S)


@task("kit_nested", size=lambda number: number)
def nested(number: float) -> float:
    check_wanted()
    return benches[-1].offload(double, number, where=ONBOARD) + 1


benches: list[Bench] = []


def test_a_task_may_call_a_task(bench: Bench) -> None:
    """The inner call runs next to the task that makes it, and its time is part of that of the task."""
    benches.append(bench)
    assert bench.offload(nested, 2, where=ONBOARD) == 5
    assert bench.records[-1].waited_s == pytest.approx(2 * ONBOARD_S)
    assert bench.offload(nested, 2, where=CLOUD) == 5
    benches.clear()


def test_a_deadline_ends_the_wait_in_virtual_time(bench: Bench) -> None:
    """The caller goes on at its deadline; the task runs to its end, and its record follows."""
    assert bench.offload(double, 1, deadline_s=1.0) == 2
    bench.cloud.dead()
    bench.onboard.slow(3.0)
    began_s, known = bench.clock.now_s(), len(bench.records)
    with pytest.raises(DeadlineMissed, match=r"no answer within 0\.5 s"):
        bench.offload(double, 2, deadline_s=0.5)
    assert bench.clock.now_s() - began_s >= 0.5
    bench.clock.pass_by(10.0)
    (record,) = bench.records[known:]
    assert (record.used, record.deadline_s) == (ONBOARD, 0.5)


def test_submitted_calls_are_answered(bench: Bench) -> None:
    """More calls than threads all get their answer, whatever the sites do."""
    for act in (bench.cloud.back, bench.cloud.dead):
        act()
        futures = [bench.offload.submit(double, number) for number in range(2 * ASYNC_CALLS_MAX)]
        assert [one.result() for one in futures] == [2 * number for number in range(2 * ASYNC_CALLS_MAX)]


def test_asyncio_calls_are_answered(bench: Bench) -> None:
    """Calls that are awaited together share the virtual time."""

    async def together() -> list[float]:
        return await asyncio.gather(*(bench.offload.run(double, number, where=CLOUD) for number in range(9)))

    assert asyncio.run(together()) == [2 * number for number in range(9)]


def test_a_batch_is_answered_although_the_cloud_dies(bench: Bench) -> None:
    """`map` returns all results in their order, with a good and with a dead cloud."""
    assert bench.offload.map(double, range(40)) == [2 * number for number in range(40)]
    bench.cloud.dead()
    assert bench.offload.map(double, range(WARM_UP)) == [2 * number for number in range(WARM_UP)]


def test_threads_of_a_program_share_the_clock(bench: Bench) -> None:
    """Four threads with calls of their own are all answered rightly."""
    answers: list[float] = []

    def work(base: int) -> None:
        answers.extend(bench.offload(double, number) for number in range(base, base + 10))

    threads = [threading.Thread(target=work, args=(10 * number,)) for number in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sorted(answers) == [2 * number for number in range(40)]


def test_a_wait_for_what_never_comes_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is one for a future that no event ends, and for a run that has no end; nothing hangs."""
    monkeypatch.setattr(shared_clock, "STUCK_S", 0.01)
    monkeypatch.setattr(shared_clock, "LONGEST_S", 60.0)
    with pytest.raises(AssertionError, match="a thread hangs"):
        SharedClock().wait([Future[None]()])
    with Bench(onboard_s=1e9) as bench, pytest.raises(AssertionError, match="virtual time, and nothing will"):
        bench.offload(double, 1, where=ONBOARD)


def test_options_are_those_of_an_offloader() -> None:
    """A wrong one is a ConfigError, observers get the records, and without heartbeats none are sent."""
    with pytest.raises(ConfigError, match="no such"):
        Bench(policy="no such")
    seen: list[Record] = []
    with Bench(policy="paper", observers=[seen.append]) as bench:
        calls(bench, 3)
        bench.clock.pass_by(EVERY_S)
        assert seen == bench.records
        assert "ping" not in {one.what for one in bench.offload.sites[CLOUD].story}
    with Bench(observe=True) as bench:
        assert used(calls(bench, 6 * KNOWN)) == {ONBOARD}
        assert bench.offload.savings()["kit_double"] is not None
    with pytest.raises(OffloadError, match="closed"):
        bench.offload(double, 1, where=ONBOARD)
