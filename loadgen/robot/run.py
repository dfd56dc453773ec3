"""One run of tasks: asks for each task when it is due, records the answers and sums them up.

The tasks come from `work`; where they run is decided by the offloader.
"""

import contextlib
import itertools
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any, TypeVar

from offboard.common import cpu_time, errors
from offboard.common.errors import ConfigError, TaskError
from offboard.common.tasks import kind_of
from offboard.loadgen.progress import Progress, progress
from offboard.loadgen.robot.answers import Answered, Answers
from offboard.loadgen.robot.calls import InputsEnded
from offboard.loadgen.robot.config import RobotConfig
from offboard.loadgen.robot.references import References
from offboard.loadgen.robot.summary import PROGRESS_EVERY, Summary, describe
from offboard.loadgen.robot.work import Work
from offboard.loadgen.robot.workload import CLOSED, due_instants
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.record import Record

MADE_MAX = 32  # tasks that are made ahead and wait for their instant
MADE_FIRST_MAX = 1000  # tasks that are made before the first one starts, if none depends on an answer
LARGE_MADE_MAX = 4  # tasks that are made ahead if their arguments may be megabytes each

T = TypeVar("T")
Keep = Callable[[Sequence[Any], Any], None]  # gets the arguments of a task and its answer (None: it failed)


class OwnRecord(threading.local):
    """An observer that keeps, for each thread, the record of the last task that this thread asked for."""

    record: Record | None = None

    def __call__(self, record: Record) -> None:
        self.record = record

    def take(self) -> Record | None:
        """Return the record and forget it."""
        record, self.record = self.record, None
        return record


class Run:
    """Asks for `config.tasks_max` tasks of `work`, the first `config.measure` of them on both sites.

    `own` must be an observer of `offload`. With `answers`, each task leaves a line there, tasks that have a
    line already are left out, and a failed task does not end the run. `keep` gets each task.
    """

    def __init__(
        self,
        config: RobotConfig,
        work: Work,
        offload: Offloader,
        *,
        own: OwnRecord,
        say: Callable[[str], None],
        answers: Answers | None = None,
        references: References | None = None,
        keep: Keep | None = None,
    ) -> None:
        self._config = config
        self._work = work
        self._offload = offload
        self._own = own
        self._say = say
        self._answers = answers
        self._references = references
        self._keep = keep
        self._done = answers.done if answers else frozenset()
        self._left = sum(number not in self._done for number in range(config.tasks_max))
        self._summary = Summary(found=work.found, due=config.arrivals != CLOSED)
        self._noted = 0
        self._progress: Progress
        self._inputs: int | None = None  # how many there were, if they have ended
        self._lock = threading.Lock()  # of the summary
        self._stopped = False
        self._start_s: float | None = None

    def warm(self, offload: Offloader) -> None:
        """Run the first task once on all sites, so that they are ready for it; the run starts with it again.

        `offload` must not be the offloader of the run, which must not learn from this or record it.
        """
        kind = kind_of(self._work.function)
        if kind.warm is not None:
            kind.warm()
        cpu_time.used_s()  # the first call takes longer: it looks for the files to read
        if kind.duplicate:
            with contextlib.suppress(TaskError):  # the run meets and reports the same failure
                offload(self._work.function, *self._work.request(), where=BOTH)

    def run(self) -> None:
        """Ask for all tasks that have no answer yet, then say the summary; after Ctrl-C or a failure, too."""
        if self._done:
            count = self._config.tasks_max
            self._say(f"{count - self._left} of {count} tasks had their answer before")
        try:
            with progress(self._work.noun, self._left, to=sys.stdout, every=PROGRESS_EVERY) as self._progress:
                if self._config.arrivals == CLOSED:
                    self._run_closed()
                else:
                    self._run_open()
        except BaseException:  # after Ctrl-C, too, the user sees what was done; nothing is swallowed
            if self._noted:
                self._say_summary()
            raise
        self._say_summary()

    def _say_summary(self) -> None:
        with self._lock:
            lines = self._summary.lines()
        if self._inputs is not None:
            self._say(f"the inputs ended after {self._inputs} of {self._config.tasks_max} tasks")
        for line in lines:
            self._say(line)

    def _run_closed(self) -> None:
        """Start each task when the previous one has its answer.

        Tasks that do not depend on answers are made before the first one starts: simulating the LiDAR must
        not take the robot's CPU during the run. Large tasks are made one by one, between two tasks.
        """
        if self._work.independent:
            requests = self._requests()
            first = deque(itertools.islice(requests, 1 if self._work.large else MADE_FIRST_MAX))
            self._begin()
            while first:
                self._ask(*first.popleft())
            for number, request in requests:
                self._ask(number, request)
            return
        for number in range(self._config.tasks_max):
            answer = None
            if number not in self._done:
                request = self._work.request()
                self._begin()
                answer = self._ask(number, request)
            self._work.advance(answer)

    def _run_open(self) -> None:
        """Start each task when it is due, or as soon as fewer than `config.in_flight` tasks are running."""
        slots = threading.BoundedSemaphore(self._config.in_flight)
        pool = ThreadPoolExecutor(self._config.in_flight, thread_name_prefix="task")
        failures: deque[BaseException] = deque(maxlen=1)

        def finish(future: "Future[Any]") -> None:
            if not future.cancelled() and (failure := future.exception()) is not None:
                failures.append(failure)
            slots.release()

        try:
            most = LARGE_MADE_MAX if self._work.large else MADE_MAX
            with contextlib.closing(made_ahead(self._due_tasks(), most)) as due_tasks:
                for number, request, due_s in due_tasks:
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
            self._stopped = True  # tasks that are given up now leave no answer
            pool.shutdown(wait=False, cancel_futures=True)
            raise

    def _requests(self) -> Iterator[tuple[int, tuple[Any, ...]]]:
        """Number and arguments of each task without an answer; no task depends on an earlier answer."""
        number = 0
        try:
            for number in range(self._config.tasks_max):
                if number not in self._done:
                    yield number, self._work.request()
                self._work.advance(None)
        except InputsEnded:
            self._inputs = number

    def _due_tasks(self) -> Iterator[tuple[int, tuple[Any, ...], float]]:
        """Number, arguments and due instant of each task without an answer, in s after the first of them."""
        config, first_s = self._config, None
        assert config.rate is not None, "checked by the config"
        instants = enumerate(due_instants(config.arrivals, config.rate, config.burst, config.seed))
        for number, request in self._requests():
            due_s = next(due_s for task, due_s in instants if task == number)
            first_s = due_s if first_s is None else first_s
            yield number, request, due_s - first_s

    def _begin(self) -> None:
        """Start the clock, at the first task."""
        if self._start_s is None:
            if self._answers:
                self._answers.begin()
            self._start_s = time.monotonic()

    def _now_s(self) -> float:
        assert self._start_s is not None, "not begun"
        return time.monotonic() - self._start_s

    def _ask(self, number: int, request: tuple[Any, ...], due_s: float | None = None) -> Any:
        """Run the task now and record how it went; return its answer, None if it failed."""
        where = BOTH if number < self._config.measure else None
        answer, described, error = None, None, None
        began_s = self._now_s()
        due_s = began_s if due_s is None else due_s
        try:
            answer = self._offload(self._work.function, *request, where=where)
            ended_s = self._now_s()
            described = self._work.describe(answer) if self._answers else None
        except Exception as failure:  # the size function of the user may raise anything
            if self._answers is None or isinstance(failure, ConfigError):
                raise
            ended_s, answer, error = self._now_s(), None, errors.describe(failure)
        record = self._own.take()
        if self._stopped:
            return None
        if self._answers:
            answered = Answered(
                i=number,
                id=record.id if record else None,
                due_s=due_s,
                began_s=began_s,
                ended_s=ended_s,
                error=error,
                answer=described,
            )
            self._answers.write(answered)
        if self._keep is not None:
            self._keep(request, answer)
        self._note(record, answer, error, late_s=began_s - due_s)
        if self._references and self._references.due(number) and record is not None:
            self._references.measure(
                number, self._work.function, request, waited_s=ended_s - due_s, record=record
            )
        return answer

    def _note(self, record: Record | None, answer: Any, error: str | None, *, late_s: float) -> None:
        with self._lock:
            if record is None or error is not None:
                self._summary.add_failure(late_s=late_s)
            else:
                self._summary.add(record, got=self._work.got(answer), late_s=late_s)
            self._noted += 1
            self._progress.step(partial(describe, record) if record else partial(str, error))


def made_ahead(tasks: Iterator[T], most: int = MADE_MAX) -> Generator[T]:
    """The same tasks in the same order, made in another thread, up to `most` of them ahead."""
    maker = ThreadPoolExecutor(1, thread_name_prefix="maker")
    try:
        made = deque(maker.submit(next, tasks, None) for _ in range(most))
        wait(made)
        while (task := made.popleft().result()) is not None:
            made.append(maker.submit(next, tasks, None))
            yield task
    finally:
        maker.shutdown(cancel_futures=True)
