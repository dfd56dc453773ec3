"""A batch: tasks of one kind on all sites at once, for `Offloader.map`.

Which task goes where is decided in `placement`; each task is then run by the offloader as any other.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from offboard.common.errors import Overtaken, TaskError
from offboard.common.tasks import Task, first_number
from offboard.common.wording import duration
from offboard.robot_client.execution.call_threads import CallThreads
from offboard.robot_client.execution.placement import SERVER_IN_FLIGHT_MAX, Queue, Start, next_start, takeover
from offboard.robot_client.policies import Decision, Forecast, Outlook
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import ONBOARD, Execution
from offboard.robot_client.sites.waiting import Clock

NAME = "map"
THREADS_MIN = 40  # calls at a time, at least: servers may come while a batch runs
BUDGET_SHARE = 0.5  # of the timeout of a server: a queue of tasks there may take this long
LOOK_AHEAD = 32  # waiting tasks that may be placed next
RECHECK_S = 0.05  # the longest wait before running tasks are checked again: one may be overdue


@dataclass(frozen=True, slots=True)
class Placed:
    """The policy of one task in a batch: the site it was placed on. `call` may name a second site later."""

    site: str
    reason: str
    call: "Future[str]" = field(default_factory=Future)

    def decide(self, forecast: Forecast) -> Decision:
        if self.site not in forecast.sites:
            return Decision(ONBOARD, f"{self.reason}; {self.site} cannot take it", NAME)
        return Decision(self.site, self.reason, NAME)


Predict = Callable[[Task, Mapping[str, int]], Forecast]
Run = Callable[[Task, Placed], tuple[Execution, Record]]


class Batch:
    """Runs all tasks once; make a new one for the next.

    `sites`: those that may be used. They may change while the batch runs.
    `predict`: makes the forecast of a size, without the wait for this batch's own tasks on each site.
    `run`: runs a task to its end; called in threads. `leave`: ends the runs that are under way.
    `timeout_s`: how long a server has for a task.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        sites: Iterable[str],
        *,
        predict: Predict,
        run: Run,
        leave: Callable[[], object],
        clock: Clock,
        timeout_s: float,
    ) -> None:
        self._tasks = tasks
        # The tasks are of one kind, so the largest takes longest, by the first number of its size.
        self._waiting = sorted(range(len(tasks)), key=lambda number: -first_number(tasks[number].size))
        self._sites = sites
        self._within_s = BUDGET_SHARE * timeout_s
        self._queues: dict[str, Queue] = {}  # also those of sites that have left
        self._predict = predict
        self._run = run
        self._leave = leave
        self._clock = clock
        self._running: dict[Future[tuple[Execution, Record]], int] = {}
        self._placed: dict[int, Placed] = {}
        self._values: dict[int, Any] = {}
        self._records: dict[int, Record] = {}
        self._errors: dict[int, BaseException] = {}

    def run(self, *, records: bool) -> list[Any]:
        """The results in the order of the tasks; if tasks failed, the first error, when all have ended.

        `records`: each result comes with its record, as a pair.
        """
        threads = CallThreads(max(THREADS_MIN, SERVER_IN_FLIGHT_MAX * len(self._own())), NAME)
        try:
            while self._waiting or self._running:
                while (start := self._next()) is not None:
                    self._start(threads, *start)
                if not self._waiting:
                    self._take_over()
                self._clock.wait(list(self._running), RECHECK_S)
                for done in [one for one in self._running if one.done()]:
                    self._finish(done)
        except BaseException:  # Ctrl-C, or the code of a site: nobody waits for what still runs
            self._leave()
            raise
        finally:
            threads.close(wait=True)
        if self._errors:
            raise self._errors[min(self._errors)]
        numbers = range(len(self._tasks))
        return [(self._values[n], self._records[n]) if records else self._values[n] for n in numbers]

    def _next(self) -> tuple[int, str, str] | None:
        """The task that should start now, with its site and the reason."""
        if not self._waiting or all(n >= self._queues[site].limit for site, n in self._own().items()):
            return None
        first = _usable(self._look(self._waiting[0]))
        for site, one in first.items():
            self._queues[site].lost_s = one.quality.lost_s
        for site in _cold(first):
            if not self._queues[site].running:
                return self._warm_up(site, first[site].observations)
        looked = self._waiting[:LOOK_AHEAD]
        sites = (_usable(self._look(number)) for number in looked)
        known = (_seconds(one, _cold(one)) for one in sites)
        start = next_start(known, self._queues, self._clock.now_s())
        return None if start is None else (looked[start.place], start.site, self._reason(start))

    def _look(self, number: int) -> Forecast:
        return self._predict(self._tasks[number], self._own())

    def _own(self) -> dict[str, int]:
        """How many tasks of the batch each site has that may be used now."""
        queues = self._queues
        return {one: len(queues.setdefault(one, Queue(one, self._within_s)).running) for one in self._sites}

    def _warm_up(self, site: str, count: int) -> tuple[int, str, str]:
        """Warm a site up with tasks of different sizes, so that its time is known for all of them."""
        place = len(self._waiting) * (count % WARM_UP + 1) // (WARM_UP + 1)
        return self._waiting[place], site, f"warm-up: too little is known of {site}"

    def _reason(self, start: Start) -> str:
        order = sorted(start.finish_s, key=lambda site: (site != start.site, start.finish_s[site]))
        said = " against ".join(self._end(site, start.finish_s[site]) for site in order)
        return f"{said}; {len(self._waiting)} tasks wait"

    def _end(self, site: str, finish_s: float) -> str:
        lost_s = self._queues[site].lost_s
        more = f" + {duration(lost_s)} for its quality" if lost_s else ""
        return f"{site} done in {duration(finish_s)}{more}"

    def _start(self, threads: CallThreads, number: int, site: str, reason: str) -> None:
        seconds = _seconds(self._look(number).sites).get(site, 0.0)
        self._waiting.remove(number)
        self._queues[site].start(number, seconds, self._clock.now_s())
        placed = self._placed[number] = Placed(site, reason)
        self._running[threads.start(self._run, self._tasks[number], placed)] = number

    def _take_over(self) -> None:
        """Let an idle site run a task too if it should end sooner there, and if second runs are allowed."""
        once = [number for number in self._running.values() if not self._placed[number].call.done()]
        if not once or all(queue.running for queue in self._queues.values()):
            return
        forecasts = {number: self._look(number) for number in once}
        sites = {number: _usable(one) for number, one in forecasts.items() if one.duplicates >= 1}
        seconds = {number: _seconds(one, _cold(one)) for number, one in sites.items()}
        now_s = self._clock.now_s()
        found = takeover(seconds, self._queues, now_s)
        if found is not None:
            number, site = found
            self._queues[site].start(number, seconds[number][site], now_s)
            self._placed[number].call.set_result(site)

    def _finish(self, done: "Future[tuple[Execution, Record]]") -> None:
        number, now_s = self._running.pop(done), self._clock.now_s()
        for queue in self._queues.values():
            if number in queue.running:
                queue.end(number, now_s)
        if (error := done.exception()) is not None:
            self._errors[number] = error
            return
        answer, record = done.result()
        self._values[number], self._records[number] = answer.value, record
        if answer.failure is not None:
            answer.failure.record = record
            self._errors[number] = answer.failure
        for one in record.executions:
            if one.site in self._queues and not isinstance(one.failure, Overtaken):
                self._hear(self._queues[one.site], one)

    def _hear(self, queue: Queue, execution: Execution) -> None:
        if execution.ok or isinstance(execution.failure, TaskError):
            queue.hear(execution.queue_s, execution.run_s)
        else:
            queue.hear(None, None)


def _usable(forecast: Forecast) -> Mapping[str, Outlook]:
    """The sites to compare: not those that are silent or given up, and not those beyond the caps."""
    if len(forecast.sites) == 1:
        return forecast.sites
    return {
        site: one
        for site, one in forecast.sites.items()
        if site == ONBOARD
        or not (
            one.condition.silent
            or one.given_up
            or one.bytes > forecast.bytes_left
            or one.joules > forecast.joules_left
        )
    }


def _cold(sites: Mapping[str, Outlook]) -> list[str]:
    """The sites of which too little is known; if there is one site only, nothing must be known."""
    if len(sites) == 1:
        return []
    return [
        site
        for site, one in sites.items()
        if one.predicted_s is None or (one.observations < WARM_UP and not one.full)
    ]


def _seconds(sites: Mapping[str, Outlook], cold: Sequence[str] = ()) -> dict[str, float]:
    return {site: max(0.0, one.predicted_s or 0.0) for site, one in sites.items() if site not in cold}
