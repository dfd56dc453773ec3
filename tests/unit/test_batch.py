"""What `Offloader.map` does with a batch, with sites that answer when they are told to."""

import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

from offboard.common.errors import CloudBroken, CloudTimeout, ConfigError, Overtaken, TaskFailed
from offboard.common.tasks import Task, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.execution.placement import SERVER_IN_FLIGHT_MAX
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies.allowance import DUPLICATES_MAX, Allowance
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.heartbeat import EVERY_S, IDLE_S
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from offboard.testing import Bench
from tests.fakes import ScriptedRunner

WAIT_S = 5.0


@task("doubled", size=lambda number: abs(float(number)))
def doubled(number: int) -> int:
    if number < 0:
        raise ValueError(f"{number} is negative")
    return 2 * number


@task("scaled", size=lambda number, factor=1: float(number * factor))
def scaled(number: int, factor: int = 1) -> int:
    return number * factor


@task("summed", size=lambda *numbers: float(sum(numbers)))
def summed(*numbers: int) -> int:
    return sum(numbers)


@task("first_of", size=lambda pair: float(pair[0]))
def first_of(pair: tuple[int, int]) -> int:
    return pair[0]


@task("stamp_once", size=lambda number: float(number), duplicate=False)
def stamp_once(number: int) -> int:
    return number


def answers(site: str, a_second: float = 100.0, **fields: Any) -> Callable[[Task], Execution]:
    """Right answers that took as long as the task is large."""

    def script(one: Task) -> Execution:
        try:
            value, failure = one.kind.function(*one.args), None
        except ValueError as error:
            value, failure = None, TaskFailed(f"ValueError: {error}")
        seconds = one.size / a_second
        return Execution(site, seconds, value, failure, queue_s=0.0, run_s=seconds, **fields)

    return script


class HeldRunner(ScriptedRunner):
    """While `holding`, answers a task only when the test calls `release`; a cancelled task is overtaken."""

    def __init__(self, site: str, script: Callable[[Task], Execution]) -> None:
        super().__init__(site, script)
        self.holding = False
        self.held: dict[int, tuple[Task, Future[Execution]]] = {}
        self.most = 0
        self._changed = threading.Condition()

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        if not self.holding:
            return super().submit(task, budget_s)
        future: Future[Execution] = Future()
        with self._changed:
            self.tasks.append(task)
            self.held[task.id] = task, future
            self.most = max(self.most, len(self.held))
            self._changed.notify_all()
        return future

    def cancel(self, task: Task) -> None:
        super().cancel(task)
        _, future = self.held.pop(task.id)
        future.set_result(Execution(self.site, 0.01, failure=Overtaken("late"), censored=True))

    def wait_for(self, count: int) -> None:
        """Wait until this many tasks are held."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.held) >= count, WAIT_S), f"{len(self.held)} held"

    def release(self) -> None:
        """Answer the task that has been held longest; wait for one if there is none."""
        self.wait_for(1)
        with self._changed:
            task, future = self.held.pop(next(iter(self.held)))
        future.set_result(self.script(task))


Make = Callable[..., Offloader]
Mapped = Callable[..., "Future[list[Any]]"]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes offloaders with least squares; `records` gets the record of each task."""
    made: list[Offloader] = []

    def factory(*runners: ScriptedRunner, records: list[Record] | None = None, **options: Any) -> Offloader:
        made.append(
            Offloader(
                list(runners),
                policy=policies.make("paper"),
                memories=Memories(lambda: predictors.make(predictors.LEAST_SQUARES, 20)),
                observers=[(records if records is not None else []).append],
                **options,
            )
        )
        return made[-1]

    yield factory
    for offload in made:
        offload.close()


def warm(offload: Offloader, function: Callable[..., Any] = doubled) -> None:
    for number in range(1, 1 + WARM_UP):
        for site in (ONBOARD, CLOUD):
            offload(function, number, where=site)


def test_answers_come_in_the_order_of_the_items(make: Make) -> None:
    """The order and the sites of the runs do not matter; each task leaves a record with its reason."""
    records: list[Record] = []
    cloud, onboard = ScriptedRunner(CLOUD, answers(CLOUD)), ScriptedRunner(ONBOARD, answers(ONBOARD))
    offload = make(cloud, onboard, records=records)
    numbers = [3, 40, 1, 17, 25, 9, 2]
    assert offload.map(doubled, iter(numbers)) == [2 * one for one in numbers]
    assert len(cloud.tasks) + len(onboard.tasks) == len(records) == len(numbers)
    assert {record.decision.policy for record in records} == {"map"}
    assert all(record.decision.reason for record in records)
    assert offload.map(doubled, []) == []


def test_an_item_is_the_argument_or_a_tuple_of_several(make: Make) -> None:
    """A tuple is unpacked if the function takes several arguments, and is passed as it is otherwise."""
    offload = make(ScriptedRunner(ONBOARD, answers(ONBOARD)))
    assert offload.map(scaled, [(2, 3), 4, (5,)]) == [6, 4, 5]
    assert offload.map(first_of, [(7, 8)]) == [7]
    assert offload.map(summed, [(1, 2), 3]) == [3, 3]
    with pytest.raises(TypeError, match="too many positional arguments"):
        offload.map(scaled, [(1, 2), (1, 2, 3)])


def test_the_first_error_is_raised_when_all_tasks_have_ended(make: Make) -> None:
    """A failed task does not stop the others, and the error of the first failed item is raised."""
    cloud, onboard = ScriptedRunner(CLOUD, answers(CLOUD)), ScriptedRunner(ONBOARD, answers(ONBOARD))
    offload = make(cloud, onboard)
    with pytest.raises(TaskFailed, match=r"ValueError: -2 is negative$"):
        offload.map(doubled, [5, -2, 8, -13, 1])
    assert sorted(one.args[0] for one in cloud.tasks + onboard.tasks) == [-13, -2, 1, 5, 8]


@pytest.fixture
def mapped() -> Iterator[Mapped]:
    """Runs `map` in a thread, so that the test can release held tasks."""
    with ThreadPoolExecutor(1) as pool:

        def start(offload: Offloader, *args: Any, **options: Any) -> "Future[list[Any]]":
            return pool.submit(offload.map, *args, **options)

        yield start


def release_all(done: "Future[list[Any]]", *runners: HeldRunner) -> list[Any]:
    """Answer held tasks, first where most are held, until the batch is done."""
    while not done.done():
        with_tasks = [runner for runner in runners if runner.held]
        if with_tasks:
            max(with_tasks, key=lambda runner: len(runner.held)).release()
    return done.result(WAIT_S)


def test_every_site_is_warmed_up_with_different_tasks(make: Make, mapped: Mapped) -> None:
    """Each site first gets WARM_UP tasks of different sizes, one at a time, and no task runs twice."""
    records: list[Record] = []
    cloud, onboard = HeldRunner(CLOUD, answers(CLOUD)), HeldRunner(ONBOARD, answers(ONBOARD, 10.0))
    cloud.holding = onboard.holding = True  # otherwise one site may run most tasks before the other is warm
    offload = make(cloud, onboard, records=records, allowance=Allowance(duplicates=0.0))
    done = mapped(offload, doubled, range(20, 60))
    for _ in range(WARM_UP - 1):
        onboard.release()
        cloud.release()
    onboard.wait_for(1)
    cloud.wait_for(1)
    assert onboard.most == cloud.most == 1
    release_all(done, onboard, cloud)
    warming = [record for record in records if record.decision.reason.startswith("warm-up")]
    for site in (ONBOARD, CLOUD):
        sizes = [record.size for record in warming if record.decision.site == site]
        assert len(sizes) == WARM_UP
        assert max(sizes) - min(sizes) >= 10
    assert len({one.args[0] for one in cloud.tasks + onboard.tasks}) == len(cloud.tasks + onboard.tasks) == 40


def test_the_largest_tasks_come_first(make: Make, mapped: Mapped) -> None:
    """The tasks start in the order of their size, so that no long task is left for the end."""
    records: list[Record] = []
    cloud = HeldRunner(CLOUD, answers(CLOUD))
    offload = make(
        cloud, ScriptedRunner(ONBOARD, answers(ONBOARD, 0.01)), records=records
    )  # far too slow to get a task
    warm(offload)
    records.clear()
    cloud.holding = True
    done = mapped(offload, doubled, [1, 5, 3, 4, 2])
    for _ in range(5):
        cloud.release()
    assert done.result(WAIT_S) == [2, 10, 6, 8, 4]
    waiting = {record.size: re.search(r"(\d+) tasks wait$", record.decision.reason) for record in records}
    assert {size: found and found[1] for size, found in waiting.items()} == {
        n: str(int(n)) for n in range(1, 6)
    }


def test_a_server_never_has_more_than_its_limit(make: Make, mapped: Mapped) -> None:
    """While its queue stays empty, a server gets more tasks at once, up to the limit; onboard gets one."""
    cloud, onboard = HeldRunner(CLOUD, answers(CLOUD)), HeldRunner(ONBOARD, answers(ONBOARD))
    offload = make(cloud, onboard)
    warm(offload)
    cloud.holding = onboard.holding = True
    done = mapped(offload, doubled, [20] * 60)
    assert release_all(done, cloud, onboard) == [40] * 60
    assert 2 < cloud.most <= SERVER_IN_FLIGHT_MAX
    assert onboard.most == 1


def straggling(
    make: Make, function: Callable[..., Any] = doubled, **options: Any
) -> tuple[Offloader, HeldRunner, HeldRunner, list[Record]]:
    """A cloud that holds its tasks, onboard with the same speed, and all second runs saved up."""
    records: list[Record] = []
    cloud, onboard = HeldRunner(CLOUD, answers(CLOUD)), HeldRunner(ONBOARD, answers(ONBOARD))
    offload = make(cloud, onboard, records=records, **options)
    for _ in range(10):
        warm(offload, function)
    cloud.holding = True
    return offload, cloud, onboard, records


def test_an_idle_site_takes_over_the_last_task(make: Make, mapped: Mapped) -> None:
    """If a server does not answer, its run is overtaken and cancelled; the task has one record."""
    offload, cloud, onboard, records = straggling(make)
    before = len(onboard.tasks)
    assert mapped(offload, doubled, [2, 2]).result(WAIT_S) == [4, 4]
    assert len(onboard.tasks) == before + 2
    assert [len(one.executions) for one in records[-2:]] == [1, 2]
    assert records[-1].used == ONBOARD
    assert [one.args for one in cloud.cancelled] == [(2,)]


@pytest.mark.parametrize(
    ("function", "options"),
    [(doubled, {"allowance": Allowance(duplicates=0.0)}), (stamp_once, {})],
    ids=["no allowance", "never twice"],
)
def test_no_task_runs_twice_without_permission(
    make: Make,
    mapped: Mapped,
    function: Callable[..., Any],
    options: dict[str, Any],
) -> None:
    """Without an allowance, or with duplicate=False, the batch waits for the slow server."""
    offload, cloud, onboard, _ = straggling(make, function, **options)
    before = len(onboard.tasks)
    done = mapped(offload, function, [2, 2])
    cloud.wait_for(1)
    with pytest.raises(futures.TimeoutError):
        done.result(0.3)
    cloud.release()
    assert len(done.result(WAIT_S)) == 2
    assert len(onboard.tasks) == before + 1
    assert not cloud.cancelled


def test_a_take_over_is_taken_from_the_allowance(make: Make, mapped: Mapped) -> None:
    """A task that an idle site takes over costs one second run."""
    allowance = Allowance()
    offload, *_ = straggling(make, allowance=allowance)
    before = allowance.duplicates
    assert before == pytest.approx(DUPLICATES_MAX)
    mapped(offload, doubled, [2, 2]).result(WAIT_S)
    assert before - 1 <= allowance.duplicates < before - 0.5


def test_a_pinned_batch_runs_on_its_site_only(make: Make) -> None:
    """A batch can be pinned to onboard, the cloud or both; an unknown site is an error at once."""
    for where, sites in ((ONBOARD, [ONBOARD]), (CLOUD, [CLOUD]), ("both", [CLOUD, ONBOARD])):
        records: list[Record] = []
        offload = make(
            ScriptedRunner(CLOUD, answers(CLOUD)), ScriptedRunner(ONBOARD, answers(ONBOARD)), records=records
        )
        assert offload.map(doubled, range(10), where=where) == list(range(0, 20, 2))
        assert all([one.site for one in record.executions] == sites for record in records)
    with pytest.raises(ConfigError, match="'edge' is not one of cloud, onboard, both"):
        offload.map(doubled, [1], where="edge")
    with pytest.raises(ConfigError, match="duplicate=False"):
        offload.map(stamp_once, [1], where="both")


def ran_on(records: Sequence[Record]) -> set[str]:
    """The sites on which these tasks ran."""
    return {one.site for record in records for one in record.executions}


def test_a_batch_leaves_out_an_unavailable_site() -> None:
    """While the cloud is absent, onboard runs the batch, even if it is pinned to the cloud."""
    with Bench() as bench:
        bench.cloud.gone()
        assert bench.offload.map(doubled, range(20)) == [2 * one for one in range(20)]
        assert bench.offload.map(doubled, [1, 2], where=CLOUD) == [2, 4]
    assert ran_on(bench.records) == {ONBOARD}


def test_a_batch_leaves_out_a_silent_site() -> None:
    """A site that does not answer heartbeats gets no task until it answers again."""
    with Bench(onboard_s=1.0) as bench:
        warm(bench.offload)
        bench.cloud.dead()
        bench.clock.pass_by(EVERY_S + IDLE_S)
        before = len(bench.records)
        assert bench.offload.map(doubled, range(20)) == [2 * one for one in range(20)]
        assert ran_on(bench.records[before:]) == {ONBOARD}
        bench.cloud.back()
        bench.clock.pass_by(EVERY_S + IDLE_S)
        bench.offload.map(doubled, range(20))
        assert ran_on(bench.records[before + 20 :]) >= {CLOUD}


def test_caps_hold_for_a_batch(make: Make) -> None:
    """When no bytes are left in this minute, all further tasks run onboard."""
    cloud = ScriptedRunner(CLOUD, answers(CLOUD, bytes_out=1000))
    offload = make(
        cloud, ScriptedRunner(ONBOARD, answers(ONBOARD, 1.0)), allowance=Allowance(bytes_a_minute=10_000)
    )
    warm(offload)
    offload.map(doubled, range(20))
    assert WARM_UP < len(cloud.tasks) < 10 + SERVER_IN_FLIGHT_MAX
    before = len(cloud.tasks)
    offload.map(doubled, range(20))
    assert len(cloud.tasks) == before


@pytest.mark.parametrize("failure", [CloudBroken("gone"), CloudTimeout("late")])
def test_a_failing_site_costs_no_answer(make: Make, mapped: Mapped, failure: Exception) -> None:
    """Tasks that fail in the cloud run onboard, and the batch has all its results."""
    records: list[Record] = []
    cloud = HeldRunner(CLOUD, lambda _: Execution(CLOUD, 2.0, failure=failure))  # type: ignore[arg-type]
    onboard = HeldRunner(ONBOARD, answers(ONBOARD, 10_000.0))  # never slower than the failing cloud
    cloud.holding = onboard.holding = True
    done = mapped(make(cloud, onboard, records=records), doubled, range(40))
    for _ in range(WARM_UP):
        cloud.release()
        onboard.wait_for(2)  # its own task, and the one that failed in the cloud
        onboard.release()
        onboard.release()
    assert release_all(done, cloud, onboard) == [2 * one for one in range(40)]
    tried = sum(len(record.executions) > 1 for record in records)
    assert WARM_UP <= tried <= 8, tried


def test_observers_and_last_see_every_task(make: Make) -> None:
    """Every task has one record with its own number, and `last` is one of them."""
    records: list[Record] = []
    offload = make(
        ScriptedRunner(CLOUD, answers(CLOUD)), ScriptedRunner(ONBOARD, answers(ONBOARD)), records=records
    )
    offload.map(doubled, range(12))
    assert sorted(record.i for record in records) == list(range(12))
    assert offload.last in records
