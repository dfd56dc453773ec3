"""The one way of every task: predict, decide, execute, learn, record.

Each step is a subject of its own in `learning`, `policies`, `execution` and `records`; this file holds the
lock under which they meet.
"""

import asyncio
import itertools
import logging
import secrets
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from offboard.common.errors import ConfigError, Overtaken
from offboard.common.tasks import Task, kind_of
from offboard.robot_client import policies
from offboard.robot_client.execution.batch import Batch, Placed, arguments
from offboard.robot_client.execution.choice import check_where, decided, pinned
from offboard.robot_client.execution.crossing_check import CrossingCheck
from offboard.robot_client.execution.race import Plan, Race, answer_of
from offboard.robot_client.learning.forecaster import Forecaster
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.learner import Learner, PendingTask
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.runs_in_flight import Flights
from offboard.robot_client.lifetime import Lifetime
from offboard.robot_client.policies import BOTH, PINNED, Decision, Forecast, Policy
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.records.recording import Recording, tell
from offboard.robot_client.records.trace import Late, Record
from offboard.robot_client.settings import Settings, check_types
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.absence import Absent, absent_sites, wait_for_sites
from offboard.robot_client.sites.clock import Clock, SystemClock
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S, Execution, Runner, checked_timeout

LATE_MAX = 64  # executions that ended after their task was answered, kept for the next record

R = TypeVar("R")

log = logging.getLogger(__name__)


class Offloader:
    """Runs each task where its policy says, always gets an answer, and learns from what happened.

    `runners`: one runner for each site, with onboard among them.
    `memories`: what is known of each kind of task, and the predictors that it is learnt with.
    `allowance`: second runs, bytes and joules that tasks may spend.
    `timeout_s`: how long a remote site has for a task before the task runs onboard.
    `observers`: called with the record of every task, in the thread that asked for it.

    Use it as a context manager, from any number of threads. A call that the code of an onboard task makes
    runs in the thread of that task if it runs onboard.
    """

    def __init__(
        self,
        runners: Sequence[Runner],
        *,
        policy: Policy,
        memories: Memories,
        allowance: Allowance | None = None,
        timeout_s: float = TIMEOUT_S,
        observers: Iterable[Callable[[Record], None]] = (),
        clock: Clock | None = None,
    ) -> None:
        self._runners = {runner.site: runner for runner in runners}
        if ONBOARD not in self._runners or len(self._runners) != len(runners):
            given = [runner.site for runner in runners]
            raise ConfigError(f"sites {given}: each site once, and {ONBOARD!r} among them")
        if BOTH in self._runners:
            raise ConfigError(f"a site cannot be named {BOTH!r}: where={BOTH!r} means all sites")
        self._policy, self._memories = policy, memories
        self._allowance = allowance or Allowance()
        self._timeout_s = checked_timeout(timeout_s)
        self._observers = tuple(observers)
        self._clock = clock or SystemClock()
        self._flights = Flights(self._runners)
        self._forecaster = Forecaster(self._runners, self._flights, self._allowance)
        self._learner = Learner(self._runners, self._allowance)
        self._late: deque[Late] = deque(maxlen=LATE_MAX)
        self._crossing = CrossingCheck()
        self._lock = threading.Lock()
        self._life = Lifetime(self._runners.values(), memories, self._lock)
        self._numbers, self._session = itertools.count(), secrets.token_hex(4)
        self.last: Record | None = None

    @classmethod
    def connect(
        cls,
        endpoint: str | None = None,
        *,
        sites: Mapping[str, str] | None = None,
        policy: str = policies.DEFAULT,
        window: int = WINDOW,
        timeout_s: float = TIMEOUT_S,
        keys: Path | str | None = None,
        observers: Iterable[Callable[[Record], None]] = (),
        metrics: str | None = None,
        trace: Path | str | None = None,
        settings: Settings | None = None,
    ) -> Self:
        """An offloader for onboard, a server `cloud` at `endpoint` (tcp://HOST:PORT), and further servers.

        `sites`: the endpoint of each further server, by name; that of a policy server is ws://HOST:PORT or
        wss://HOST:PORT.
        `policy`: the name of a policy; caps in the settings add the wrapper `budget` to it.
        `window`: observations of each kind on each site that predictions rest on.
        `timeout_s`: how long a server has for a task before the task runs onboard, in seconds.
        `keys`: the folder of `robot-client keys`, with the public key of each server in NAME.key or
        server.key (None: no encryption).
        `observers`: called with the record of every task. `settings`: options that few robots need.
        `metrics`: HOST:PORT where Prometheus reads `/metrics`. `trace`: the file that gets every record.
        """
        from offboard.robot_client.make_runners import make_runners  # zmq is loaded only for a connection

        check_types(cls.connect, locals())
        rare = settings or Settings()
        chosen, memories = rare.make_policy(policy), rare.make_memories(policy, window)
        servers = ({CLOUD: endpoint} if endpoint else {}) | dict(sites or {})
        heartbeat_s = heartbeat.EVERY_S if rare.beats(policy) else 0.0
        with ExitStack() as opened:
            recording = Recording(trace=trace, metrics=metrics)
            opened.callback(recording.close)
            runners = make_runners(servers, keys=keys, heartbeat_s=heartbeat_s, settings=rare)
            for runner in runners:
                opened.callback(runner.close)
            offload = cls(
                runners,
                policy=chosen,
                memories=memories,
                allowance=rare.allowance(),
                timeout_s=timeout_s,
                observers=[*observers, *recording.observers],
            )
            opened.pop_all()
        offload._life.recording = recording
        offload._life.close_when_dropped(offload)
        return offload

    def __call__(
        self,
        function: Callable[..., R],
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        **kwargs: Any,
    ) -> R:
        """Run a `@task` function and return its result; TaskFailed if the function itself raised.

        `where` pins the call to a site, or to `both` to measure all of them. `timeout_s` bounds the wait for
        a remote site, after which the task runs onboard.
        """
        if self._life.forked:
            self._life.refuse()
        budget_s = self._timeout_s if timeout_s is None else checked_timeout(timeout_s)
        kind = kind_of(function)
        args = kind.bind(args, kwargs)
        answer, _ = self._answer(where, budget_s, Task(kind, args, kind.size_of(args)))
        if answer.failure is not None:
            raise answer.failure
        return cast("R", answer.value)

    def map(
        self,
        function: Callable[..., R],
        items: Iterable[Any],
        *,
        where: str | None = None,
        timeout_s: float | None = None,
    ) -> list[R]:
        """Run a `@task` function on every item, on all sites at once, so that the last one ends soonest.

        An item is the argument, or a tuple of all arguments if the function takes several. The results come
        in the order of the items. If tasks fail, the error of the first one is raised when all have ended.
        `where` and `timeout_s` are those of a single call. Observers are called in threads of the batch.
        """
        if self._life.forked:
            self._life.refuse()
        budget_s = self._timeout_s if timeout_s is None else checked_timeout(timeout_s)
        kind = kind_of(function)
        tasks = [Task(kind, args, kind.size_of(args)) for args in arguments(kind, items)]
        sites = tuple(self._runners)
        if where is not None:
            check_where(where, kind, self._runners)
            sites = (ONBOARD if where == BOTH else where,)
        batch = Batch(
            tasks,
            sites,
            predict=partial(self._expect, budget_s),
            run=partial(self._answer, where, budget_s),
            clock=self._clock,
            timeout_s=budget_s,
        )
        return batch.run()

    async def run(self, function: Callable[..., R], *args: Any, **options: Any) -> R:
        """The same call for asyncio; the event loop is free while the task runs.

        At most ASYNC_CALLS_MAX calls are made at a time; further ones wait. If the caller is cancelled, it
        does not wait for the task, which runs to its end.
        """
        if self._life.forked:
            self._life.refuse()
        call = partial(self, function, *args, **options)
        return await asyncio.wrap_future(self._life.call_in_thread(call))

    def wait_for_sites(self, function: Callable[..., Any], timeout_s: float) -> Absent:
        """Wait until every site can take this task, and onboard has run its setup, for at most `timeout_s`.

        Returns why some sites still cannot: a dictionary by site, which is empty if all can. It returns at
        once if waiting changes nothing, as for a server that has other source.
        """
        if self._life.forked:
            self._life.refuse()
        return wait_for_sites(self._runners, kind_of(function), timeout_s)

    def close(self) -> None:
        """Close all runners, trace and metrics, and save what was learnt. Safe to call twice."""
        self._life.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(
        self, where: str | None, budget_s: float, task: Task, placed: Placed | None = None
    ) -> tuple[Execution, Record]:
        """One task from its arguments to its record; `placed` replaces the policy."""
        if len(self._runners) > 1:
            self._crossing.check_arguments(task)
        answer, record = self._offload(task, where, budget_s, placed)
        self.last = record
        tell(self._observers, record)
        if len(record.executions) > 1:
            self._crossing.hear(task.kind, record.executions)
        if len(self._runners) > 1 and answer.failure is None:
            self._crossing.check_result(task.kind, answer.value)
        return answer, record

    def _offload(
        self, task: Task, where: str | None, budget_s: float, placed: Placed | None
    ) -> tuple[Execution, Record]:
        """Predict, decide, execute, learn, record."""
        started_at, started = datetime.now(UTC), self._clock.now_s()
        number = next(self._numbers)
        absent = absent_sites(self._runners, task.kind)
        with self._lock:
            pending = self._ask(
                task,
                f"{self._session}-{number}",
                absent=absent,
                where=where,
                timeout_s=budget_s,
                placed=placed,
            )
        executions = self._execute(pending, budget_s, placed.call if placed else None)
        answer = answer_of(executions)
        with self._lock:
            self._learn(pending, executions)
            if not self._life.closed and self._memories.due(self._clock.now_s()):
                self._memories.save_soon()
            late, regret = tuple(self._late), self._learner.regret.estimate()
            self._late.clear()
        record = Record(
            i=number,
            id=pending.id,
            kind=task.kind.name,
            size=task.size,
            sites=pending.forecast.sites,
            decision=pending.decision,
            executions=tuple(execution.without_value() for execution in executions),
            used=answer.site if answer.ok else None,
            waited_s=self._clock.now_s() - started,
            amount=pending.amount,
            late=late,
            regret=regret,
            started_at=started_at,
        )
        return answer, record

    def _ask(
        self,
        task: Task,
        id: str,
        *,
        absent: Mapping[str, str],
        where: str | None,
        timeout_s: float,
        placed: Placed | None,
    ) -> PendingTask:
        """Predict and decide."""
        now_s = self._clock.now_s()
        self._allowance.begin(now_s)
        memory = self._memories.of(task.kind, self._runners)
        sites = [site for site in self._runners if site not in absent] if absent else self._runners
        forecast = self._forecaster.forecast(memory, task, sites, timeout_s=timeout_s, now_s=now_s)
        if where is not None:
            check_where(where, task.kind, self._runners)
            decision = pinned(where, forecast)
        else:
            decision = decided(
                placed or self._policy, forecast, task.kind, absent=absent, known=memory.observations
            )
            if placed is None:
                self._note_move(memory, decision)
        return PendingTask(
            task=task,
            id=id,
            memory=memory,
            forecast=forecast,
            amount=memory.amount(task.size),
            decision=decision,
        )

    def _note_move(self, memory: KindMemory, decision: Decision) -> None:
        if decision.site == memory.last_site:
            return
        if memory.last_site is not None:
            log.info("%s moves to %s: %s", memory.kind.name, decision.site, decision.reason)
        memory.last_site = decision.site

    def _expect(self, timeout_s: float, task: Task, own: Mapping[str, int]) -> Forecast:
        """What a batch is placed by; `own` holds how many of its tasks each site has."""
        absent = absent_sites(self._runners, task.kind) if len(own) > 1 else {}
        present = {site: count for site, count in own.items() if site not in absent}
        with self._lock:
            memory = self._memories.of(task.kind, self._runners)
            return self._forecaster.forecast_in_batch(memory, task, present, timeout_s=timeout_s)

    def _execute(
        self, pending: PendingTask, timeout_s: float, call: "Future[str] | None"
    ) -> tuple[Execution, ...]:
        decision, sites = pending.decision, pending.forecast.sites
        race = Race(
            pending.task,
            self._runners,
            self._clock,
            timeout_s,
            begun=partial(self._begun, pending),
            allowed=self._take_duplicate,
            late=partial(self._ended_late, pending),
        )
        first: tuple[str, ...] = (decision.site,)
        if decision.both:
            first = tuple(site for site in sites if site not in decision.spared)
            if decision.policy != PINNED:  # a measurement is the choice of the caller, not of the policy
                self._take_duplicates(len(first) - 1)
        try:
            return race.run(Plan(first, decision.second, all=decision.both, call=call))
        except BaseException:  # closed during the task, or Ctrl-C: nobody waits for what still runs
            with self._lock:
                self._flights.end_all(pending.task.id)
            raise

    def _begun(self, pending: PendingTask, site: str) -> None:
        outlook = pending.forecast.sites.get(site)
        predicted_s = (outlook.predicted_s if outlook else None) or 0.0
        with self._lock:
            self._flights.begin(site, pending.task.id, predicted_s=predicted_s, now_s=self._clock.now_s())

    def _take_duplicates(self, count: int) -> None:
        with self._lock:
            for _ in range(count):
                self._allowance.duplicate()

    def _take_duplicate(self) -> bool:
        """Whether a second run may start; it is then counted. A fallback needs no permission."""
        with self._lock:
            return self._allowance.take_duplicate()

    def _learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn the runs that have ended by now."""
        for one in executions:
            if not isinstance(one.failure, Overtaken):
                self._flights.end(one.site, pending.task.id)
        if not self._life.closed:  # a run that `close` gave up says nothing about its site
            self._learner.learn(pending, executions)

    def _ended_late(self, pending: PendingTask, site: str, execution: Execution) -> None:
        """A run has ended after its task was answered; called in any thread."""
        with self._lock:
            self._late.append(Late.of(pending.id, site, execution))
            self._flights.end(site, pending.task.id)
            if execution.started and not self._life.closed:
                self._learner.learn_late(pending, execution)
