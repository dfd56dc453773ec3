"""The robot at work: asks for each task when it is due, notes what came back, goes on, and sums it up."""

import contextlib
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any, TypeVar

from offboard.common import errors
from offboard.common.errors import ConfigError, TaskError
from offboard.common.host import cpu_time
from offboard.common.tasks import kind_of
from offboard.robot_client.offloader import BOTH, Offloader
from offboard.robot_client.records.trace import Record
from offboard.robot_client.simulated.answers import Answered, Answers
from offboard.robot_client.simulated.config import RobotConfig
from offboard.robot_client.simulated.references import References, orders
from offboard.robot_client.simulated.summary import Summary, describe, show_progress
from offboard.robot_client.simulated.task_source import Work
from offboard.robot_client.simulated.workload import CLOSED, due_instants
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

MADE_MAX = 32  # tasks that wait, ready made, for their instant
MADE_FIRST_MAX = 1000  # made before the first is asked for, where none depends on an answer
WAYS = (ONBOARD, CLOUD, BOTH)  # in which `Drive.run_alone` runs each of its tasks

T = TypeVar("T")


class OwnRecord(threading.local):
    """An observer that keeps, for each thread, the record of the task that it asked for last."""

    record: Record | None = None

    def __call__(self, record: Record) -> None:
        self.record = record

    def take(self) -> Record | None:
        """The record, once."""
        record, self.record = self.record, None
        return record


class Drive:
    """Asks for `config.tasks` tasks of `work`, the first `config.measure` of them on both sites.

    `own` is an observer of `offload`. With `answers` every task leaves a line there, those that have one
    are not asked again, and a task that fails does not end the run.
    """

    def __init__(
        self,
        config: RobotConfig,
        work: Work,
        offload: Offloader,
        own: OwnRecord,
        say: Callable[[str], None],
        *,
        answers: Answers | None = None,
        references: References | None = None,
    ) -> None:
        self._config = config
        self._work = work
        self._offload = offload
        self._own = own
        self._say = say
        self._answers = answers
        self._references = references
        self._done = answers.done if answers else frozenset()
        self._left = sum(number not in self._done for number in range(config.tasks))
        self._summary = Summary(found=work.found, due=config.arrivals != CLOSED)
        self._noted = 0
        self._lock = threading.Lock()  # of the summary
        self._stopped = False
        self._start_s: float | None = None

    def warm(self, offload: Offloader) -> None:
        """Get all sites ready for the first measured task; it is the same task afterwards.

        `offload` is not the one of the run, which shall learn and record nothing of this.
        """
        kind = kind_of(self._work.function)
        if kind.warm is not None:
            kind.warm()
        cpu_time.used_s()  # the first call looks for what to read
        if kind.duplicate:
            with contextlib.suppress(TaskError):  # task 0 will say it again
                offload(self._work.function, *self._work.request(), where=BOTH)

    def run(self) -> None:
        """All tasks that have no answer yet, and the summary."""
        if self._done:
            self._say(
                f"{self._config.tasks - self._left} of {self._config.tasks} tasks had their answer before"
            )
        if self._config.arrivals == CLOSED:
            self._run_closed()
        else:
            self._run_open()
        for line in self._summary.lines():
            self._say(line)

    def run_alone(self, offload: Offloader) -> None:
        """`config.alone` further tasks, each run in all WAYS one after the other, in turning order.

        `offload` knows onboard and the cloud, and nobody else.
        """
        whole, what = 0, "plans" if self._config.map else "tasks"
        for number, order in enumerate(orders(self._config.alone, self._config.seed, WAYS)):
            request, ran = self._work.request(), 0
            for n, way in enumerate(order, 1):
                answer = offload(self._work.function, *request, where=way)
                record = offload.last
                assert record is not None
                ran += _ran(record, way)
                show_progress(
                    number * len(WAYS) + n, self._config.alone * len(WAYS), partial(describe, record)
                )
            self._work.advance(answer)
            whole += ran == len(WAYS)
        missing = f"; the {CLOUD} did not answer for the others" if whole < self._config.alone else ""
        self._say(
            f"run on each site alone and on both at once: {whole} of {self._config.alone} {what}{missing}"
        )

    def _run_closed(self) -> None:
        """Each task when the last is answered.

        Where they can, they are made before: what simulates a LiDAR is not to take the CPU of the robot.
        """
        if self._work.independent:
            requests = self._requests()
            first = deque(itertools.islice(requests, MADE_FIRST_MAX))
            self._begin()
            while first:
                self._ask(*first.popleft())
            for number, request in requests:
                self._ask(number, request)
            return
        for number in range(self._config.tasks):
            answer = None
            if number not in self._done:
                request = self._work.request()
                self._begin()
                answer = self._ask(number, request)
            self._work.advance(answer)

    def _run_open(self) -> None:
        """Each task when it is due, or as soon as fewer than `config.in_flight` are under way."""
        slots = threading.BoundedSemaphore(self._config.in_flight)
        pool = ThreadPoolExecutor(self._config.in_flight, thread_name_prefix="task")
        failures: deque[BaseException] = deque(maxlen=1)

        def finish(future: "Future[Any]") -> None:
            if not future.cancelled() and (failure := future.exception()) is not None:
                failures.append(failure)
            slots.release()

        try:
            with contextlib.closing(made_ahead(self._made())) as made:
                for number, request, due_s in made:
                    self._begin()
                    time.sleep(max(0.0, due_s - self._now_s()))
                    slots.acquire()
                    if failures:
                        break
                    pool.submit(self._ask, number, request, due_s).add_done_callback(finish)
            pool.shutdown()
            if failures:
                raise failures[0]
        except BaseException:  # Ctrl-C too
            self._stopped = True  # what is given up now is not answered
            pool.shutdown(wait=False, cancel_futures=True)
            raise

    def _requests(self) -> Iterator[tuple[int, tuple[Any, ...]]]:
        """Number and arguments of each task without an answer; none depends on the one before."""
        for number in range(self._config.tasks):
            if number not in self._done:
                yield number, self._work.request()
            self._work.advance(None)

    def _made(self) -> Iterator[tuple[int, tuple[Any, ...], float]]:
        """Number, arguments and due instant, in s after that of the first, of each task without an answer."""
        config, first_s = self._config, None
        assert config.rate is not None, "checked by the config"
        instants = enumerate(due_instants(config.arrivals, config.rate, config.burst, config.seed))
        for number, request in self._requests():
            due_s = next(due_s for task, due_s in instants if task == number)
            first_s = due_s if first_s is None else first_s
            yield number, request, due_s - first_s

    def _begin(self) -> None:
        """The first task is due: times count from here."""
        if self._start_s is None:
            if self._answers:
                self._answers.begin()
            self._start_s = time.monotonic()

    def _now_s(self) -> float:
        assert self._start_s is not None, "not begun"
        return time.monotonic() - self._start_s

    def _ask(self, number: int, request: tuple[Any, ...], due_s: float | None = None) -> Any:
        """Run the task now and note how it went; its answer, None where it has none."""
        where = BOTH if number < self._config.measure else None
        answer, described, error = None, None, None
        began_s = self._now_s()
        due_s = began_s if due_s is None else due_s
        try:
            answer = self._offload(self._work.function, *request, where=where)
            ended_s = self._now_s()
            described = self._work.describe(answer) if self._answers else None
        except Exception as failure:  # also what the user's own size function raises
            if self._answers is None or isinstance(failure, ConfigError):
                raise
            ended_s, answer, error = self._now_s(), None, errors.describe(failure)
        record = self._own.take()
        if self._stopped:
            return None
        if self._answers:
            own_id = record.id if record else None
            self._answers.write(Answered(number, own_id, due_s, began_s, ended_s, error, described))
        self._note(record, answer, error, began_s - due_s)
        if self._references and self._references.due(number) and record is not None:
            self._references.measure(
                number, self._work.function, request, waited_s=ended_s - due_s, record=record
            )
        return answer

    def _note(self, record: Record | None, answer: Any, error: str | None, late_s: float) -> None:
        with self._lock:
            if record is None or error is not None:
                self._summary.add_failure(late_s=late_s)
            else:
                self._summary.add(record, got=self._work.got(answer), late_s=late_s)
            self._noted += 1
            show_progress(
                self._noted, self._left, partial(describe, record) if record else partial(str, error)
            )


def made_ahead(tasks: Iterator[T]) -> Generator[T]:
    """The same in the same order, made by one thread, up to MADE_MAX of them before they are asked for."""
    maker = ThreadPoolExecutor(1, thread_name_prefix="maker")
    try:
        made = deque(maker.submit(next, tasks, None) for _ in range(MADE_MAX))
        wait(made)
        while (task := made.popleft().result()) is not None:
            made.append(maker.submit(next, tasks, None))
            yield task
    finally:
        maker.shutdown(cancel_futures=True)


def _ran(record: Record, way: str) -> bool:
    """Whether it ran well where it was sent, and nowhere else."""
    sent = [ONBOARD, CLOUD] if way == BOTH else [way]
    return sorted(one.site for one in record.executions if one.ok) == sorted(sent)
