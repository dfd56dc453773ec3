"""The one way of every task: predict, decide, execute, learn, record.

Each step is a subject of its own in `learning`, `policies`, `execution` and `records`; this file holds the
lock under which they meet.
"""

import itertools
import secrets
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

from offboard.common.errors import ConfigError
from offboard.common.live.look import RobotLive
from offboard.common.source.comparison import kind_in_use
from offboard.common.tasks import Task
from offboard.robot_client import policies
from offboard.robot_client.calls import Calls, Options, R, Seconds
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.execution.batch import Batch, Placed
from offboard.robot_client.execution.call_future import CallFuture, chunk_of
from offboard.robot_client.execution.choice import check_where, decided, pinned, sites_at
from offboard.robot_client.execution.race import ROUNDING_S, answer_of
from offboard.robot_client.learning.forecaster import Forecaster
from offboard.robot_client.learning.learner import Learner, PendingTask
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.runs_in_flight import Flights
from offboard.robot_client.learning.savings import Savings
from offboard.robot_client.lifetime import Lifetime
from offboard.robot_client.policies import BOTH, Forecast, Policy
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.decision import pairs
from offboard.robot_client.policies.expectation import Expectation, expectations, missed
from offboard.robot_client.policies.forecast import finishes_of
from offboard.robot_client.policies.objectives import by_deadline
from offboard.robot_client.policies.observe import Observe
from offboard.robot_client.records.record import Record
from offboard.robot_client.records.recording import Recording, record_of, tell
from offboard.robot_client.settings import Settings, check_types
from offboard.robot_client.sites.absence import Absent, CrossingCheck, SiteView, absent_sites, wait_for_sites
from offboard.robot_client.sites.outgoing import new_task
from offboard.robot_client.sites.runner import ONBOARD, TIMEOUT_S, Execution, Runner, checked_timeout
from offboard.robot_client.sites.waiting import Clock, SystemClock
from offboard.robot_client.streams.counts import StreamMetrics
from offboard.robot_client.task_runs import TaskRuns

Own = TypeVar("Own", bound="Offloader")


class Offloader(Calls):
    """Runs each task where its policy says, always gets an answer, and learns from what happened.

    `runners`: one runner for each site, with onboard among them; or sites that change.
    `memories`: what is known of each kind of task, and the predictors that it is learnt with.
    `allowance`: second runs, bytes and joules that tasks may spend.
    `timeout_s`: how long a remote site has for a task before the task runs onboard.
    `observers`: called with the record of every task, in the thread that asked for it; with a deadline, in
    another one.

    Use it as a context manager, from any number of threads. A call that the code of an onboard task makes
    runs in the thread of that task if it runs onboard.
    """

    def __init__(
        self,
        runners: Sequence[Runner] | PresentSites,
        *,
        policy: Policy,
        memories: Memories,
        allowance: Allowance | None = None,
        timeout_s: float = TIMEOUT_S,
        observers: Iterable[Callable[[Record], None]] = (),
        clock: Clock | None = None,
    ) -> None:
        sites = self._sites = runners if isinstance(runners, PresentSites) else PresentSites(runners)
        if BOTH in sites:
            raise ConfigError(f"a site cannot be named {BOTH!r}: where={BOTH!r} means all sites")
        self._policy, self._memories, self._pairs = policy, memories, pairs(policy)
        self._observes = isinstance(policy, Observe)
        self._allowance = allowance or Allowance()
        self._timeout_s = checked_timeout(timeout_s)
        self._observers, self._clock = tuple(observers), clock or SystemClock()
        self._flights = Flights()
        sites.in_flight = self._flights.count
        self._forecaster = Forecaster(self._flights, self._allowance, memories.weighing)
        self._learner = Learner(self._allowance, memories.weighing)
        self._crossing = CrossingCheck()
        self._streams = StreamMetrics()
        self._lock = threading.Lock()
        self._life = Lifetime(sites, memories, self._lock)
        self._runs = TaskRuns(
            self._clock,
            self._lock,
            flights=self._flights,
            allowance=self._allowance,
            learner=self._learner,
            life=self._life,
        )
        self._numbers, self._session = itertools.count(), secrets.token_hex(4)
        self.last: Record | None = None

    @classmethod
    def connect(
        cls: type[Own],
        endpoint: str | None = None,
        *,
        sites: Mapping[str, str] | Path | str | None = None,
        policy: str = policies.DEFAULT,
        timeout_s: float = TIMEOUT_S,
        keys: Path | str | None = None,
        observers: Iterable[Callable[[Record], None]] = (),
        metrics: str | None = None,
        trace: Path | str | None = None,
        observe: bool = False,
        settings: Settings | None = None,
    ) -> Own:
        """An offloader for onboard, a server `cloud` at `endpoint` (tcp://HOST:PORT), and further servers.

        `sites`: the endpoint of each further server, by name: tcp://HOST:PORT; ws:// or wss://HOST:PORT, a
        policy server; dns://HOST:PORT, a server at each address of HOST. Or the TOML file that lists servers.
        File and addresses are read again and again.
        `policy`: the name of a policy; caps in the settings add the wrapper `budget` to it.
        `timeout_s`: how long a server has for a task before the task runs onboard, in seconds.
        `keys`: the folder of `robot-client keys`, with the public key of each server in NAME.key or
        server.key (None: no encryption).
        `observers`: called with the record of every task. `settings`: options that few robots need.
        `metrics`: HOST:PORT where Prometheus reads `/metrics`. `trace`: the file that gets every record.
        `observe`: answer every task onboard, and estimate what the policy would save (`savings`).
        """
        from offboard.robot_client.servers import connect_sites  # zmq is loaded only for a connection

        check_types(cls.connect, locals())
        rare = settings or Settings()
        chosen, memories = rare.make_policy(policy), rare.make_memories(policy)
        with ExitStack() as opened:
            recording = Recording(trace=trace, metrics=metrics)
            opened.callback(recording.close)
            present = connect_sites(endpoint, sites or {}, keys=keys, policy=policy, settings=rare)
            opened.callback(present.close)
            offload = cls(
                present,
                policy=Observe(chosen) if observe else chosen,
                memories=memories,
                allowance=rare.allowance(),
                timeout_s=timeout_s,
                observers=[*observers, *recording.observers],
            )
            opened.pop_all()
        offload._life.recording = recording
        recording.show(offload._streams)
        if recording.live is not None:
            offload.show_on(recording.live)
        offload._life.close_when_dropped(offload)
        return offload

    @overload
    def map(
        self, function: Callable[..., R], items: Iterable[Any], *,
        where: str | None = ..., timeout_s: Seconds = ..., records: Literal[False] = ...,
    ) -> list[R]: ...  # fmt: skip
    @overload
    def map(
        self, function: Callable[..., R], items: Iterable[Any], *,
        where: str | None = ..., timeout_s: Seconds = ..., records: Literal[True],
    ) -> list[tuple[R, Record]]: ...  # fmt: skip
    def map(
        self,
        function: Callable[..., R],
        items: Iterable[Any],
        *,
        where: str | None = None,
        timeout_s: float | None = None,
        records: bool = False,
    ) -> list[R] | list[tuple[R, Record]]:
        """Run a `@task` function on every item, on all sites at once, so that the last one ends soonest.

        An item is the argument, or a tuple of all arguments if the function takes several. The results come
        in the order of the items; with `records`, each with the record of its call. If tasks fail, the error
        of the first one is raised when all have ended. `where` and `timeout_s` are those of a single call.
        Observers are called in threads of the batch. If the batch is left by Ctrl-C, its runs are left too.
        """
        self._life.refuse_in_fork()
        budget_s = self._timeout_s if timeout_s is None else checked_timeout(timeout_s)
        kind = kind_in_use(function)
        tasks = [new_task(kind, kind.bind(kind.arguments_in(item), {})) for item in items]
        runners = self._sites.now
        where = where or (ONBOARD if self._observes else None)
        if where is not None:
            check_where(where, kind, runners, changing=self._sites.changing)
        caller = CallFuture[Any]()  # one for all tasks, so that the batch can leave all of them
        return Batch(
            tasks,
            self._sites if where is None else (*sites_at(where, runners), ONBOARD)[:1],
            predict=partial(self._expect_in_batch, runners),
            run=partial(self._answer, where, budget_s, caller=caller),
            leave=caller.cancel,
            clock=self._clock,
            timeout_s=budget_s,
        ).run(records=records)

    def expect(
        self, function: Callable[..., Any], /, *args: Any, deadline_s: float | None = None, **kwargs: Any
    ) -> dict[str, Expectation]:
        """What this call should take on each site, and how likely it is in time; nothing runs or counts."""
        self._life.refuse_in_fork()
        kind = kind_in_use(function)
        task, runners = new_task(kind, kind.bind(args, kwargs)), self._sites.now
        absent = absent_sites(runners, kind)
        with self._lock:
            memory, now_s = self._memories.of(kind, runners), self._clock.now_s()
            forecast = self._forecaster.forecast(memory, task, absent.others_of(runners), now_s=now_s)
            if deadline_s is not None:
                slowest_s = memory.slowest_onboard_s(task.size) if self._pairs else None
                within_s = checked_timeout(deadline_s, "deadline_s")
                forecast = by_deadline(forecast, within_s, slowest_s=slowest_s)
        return expectations(forecast, absent)

    @property
    def sites(self) -> Mapping[str, SiteView]:
        """Each site as it is now, by its name: a copy that does not change."""
        return self._sites.views()

    def __repr__(self) -> str:
        return f"<Offloader {'; '.join(f'{site}: {view}' for site, view in self.sites.items())}>"

    def savings(self) -> dict[str, Savings | None]:
        """With `observe`: what offloading would have saved, by name of the task; None while it is unknown."""
        self._life.refuse_in_fork()
        with self._lock:
            return self._learner.savings()

    def wait_for_sites(self, function: Callable[..., Any], timeout_s: float) -> Absent:
        """Wait until every site can take this task, and onboard has run its setup, for at most `timeout_s`.

        Returns why some sites still cannot: a dictionary by site, which is empty if all can. It returns at
        once if waiting changes nothing, as for a server that has other source. With 0 it only looks.
        """
        self._life.refuse_in_fork()
        if timeout_s != 0:
            timeout_s = checked_timeout(timeout_s)
        return wait_for_sites(self._sites, kind_in_use(function), timeout_s, self._sites.awaited)

    def show_on(self, live: RobotLive[Record]) -> None:
        """Show these sites and this allowance on a live page, next to the records that it gets."""
        live.show(self._sites, self._allowance)

    def close(self) -> None:
        """Close all runners, trace and metrics, and save what was learnt. Safe to call twice."""
        self._life.close()

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_call(
        self, task: Task, options: Options, caller: CallFuture[Any] | None
    ) -> tuple[Execution, Record]:
        where, timeout_s, deadline_s = options
        budget_s = self._timeout_s if timeout_s is None else checked_timeout(timeout_s)
        if deadline_s is None:
            return self._finish(self._begin(task, where, budget_s, caller=caller))
        task, within_s = self._hurried(task, deadline_s)
        pending = self._begin(task, where, budget_s, deadline_s=within_s, caller=caller)
        return self._answer_in_time(pending, within_s)

    def _answer(
        self,
        where: str | None,
        budget_s: float,
        task: Task,
        placed: Placed | None = None,
        *,
        caller: CallFuture[Any] | None = None,
    ) -> tuple[Execution, Record]:
        """One task from its arguments to its record; `placed` replaces the policy."""
        return self._finish(self._begin(task, where, budget_s, placed=placed, caller=caller))

    def _answer_in_time(self, pending: PendingTask, deadline_s: float) -> tuple[Execution, Record]:
        """The answer to one task; DeadlineMissed if there is none after `deadline_s`."""
        until_s = pending.started_s + deadline_s
        answered = pending.answered = Future()
        call = self._life.call_beside(partial(self._finish, pending))
        self._clock.wait([answered, call], max(0.0, until_s - self._clock.now_s()))
        if call.done() and not answered.done():
            call.result()  # the error that kept it from an answer
        if answered.done():
            answer, record, answered_s = answered.result()
            if answered_s <= until_s or record.cancelled:
                return answer, record
        self._life.leave(call)
        executions = () if pending.so_far is None else pending.so_far()
        ended_s = max(until_s + ROUNDING_S, self._clock.now_s())
        error = missed(pending.task.kind.name, deadline_s, pending.forecast, pending.absent)
        record = record_of(pending, executions, None, ended_s=ended_s)
        error.record = record if pending.caller is None else pending.caller.keep(record)
        raise error

    def _begin(
        self,
        task: Task,
        where: str | None,
        budget_s: float,
        *,
        placed: Placed | None = None,
        deadline_s: float | None = None,
        caller: CallFuture[Any] | None = None,
    ) -> PendingTask:
        """Predict and decide."""
        runners = self._sites.now
        if len(runners) > 1:
            self._crossing.check_arguments(task)
        started_at, started_s, number = datetime.now(timezone.utc), self._clock.now_s(), next(self._numbers)
        absent = absent_sites(runners, task.kind)
        with self._lock:
            self._allowance.begin(started_s)
            memory, present = self._memories.of(task.kind, runners), absent.others_of(runners)
            forecast = self._forecaster.forecast(memory, task, present, now_s=started_s)
            if self._sites.changing:
                self._sites.count_task(finishes_of(forecast), started_s)
            within_s = self._memories.deadline_s if deadline_s is None else deadline_s
            if within_s is not None:
                paired = self._pairs and where is None and placed is None
                slowest_s = memory.slowest_onboard_s(task.size) if paired else None
                forecast = by_deadline(forecast, within_s, slowest_s=slowest_s)
            if where is not None:
                check_where(where, task.kind, runners, changing=self._sites.changing)
                decision = pinned(where, forecast)
            else:
                known, policy = memory.observations, placed or self._policy
                decision = decided(policy, forecast, task.kind, absent=absent, known=known)
                if placed is None and decision.site != memory.last_site:
                    memory.move_to(decision.site, decision.reason)
            amount = memory.amount(task.size)
        return PendingTask(
            task=task,
            runners=runners,
            i=number,
            id=f"{self._session}-{number}",
            memory=memory,
            forecast=forecast,
            amount=amount,
            decision=decision,
            timeout_s=budget_s,
            started_s=started_s,
            started_at=started_at,
            absent=absent,
            call=placed.call if placed else None,
            deadline_s=deadline_s,
            caller=caller,
        )

    def _finish(self, pending: PendingTask) -> tuple[Execution, Record]:
        """Execute, learn, record."""
        return self._end(pending, self._runs.execute(pending))

    def _end(self, pending: PendingTask, executions: tuple[Execution, ...]) -> tuple[Execution, Record]:
        task, answer = pending.task, answer_of(executions, pending.task.kind)
        answered_s = self._clock.now_s()
        chunk = None if pending.caller is None else chunk_of(pending.caller, answer)
        with self._lock:
            self._runs.learn(pending, executions)
            if not self._life.closed and self._memories.due(answered_s):
                self._memories.save_soon()
            late = self._runs.take_late() if self._runs.late else ()
            regret = self._learner.regret.estimate()
            saved = self._learner.savings().get(task.kind.name) if self._observes else None
        used = None if pending.cancelled else answer
        ended_s = self._clock.now_s() if pending.deadline_s is None else answered_s
        record = self.last = record_of(
            pending, executions, used, ended_s=ended_s, late=late, regret=regret, savings=saved
        )
        record.chunk = chunk
        if pending.answered is not None:  # its caller waits for no observer
            pending.answered.set_result((answer, record, answered_s))
        if pending.caller is not None:
            pending.caller.keep(record)
        tell(self._observers, record)
        if len(executions) > 1:
            self._crossing.hear(task.kind, executions)
        if len(pending.runners) > 1 and answer.failure is None and not pending.cancelled:
            self._crossing.check_result(task.kind, answer.value)
            if self._observes and (site := pending.decision.measured) is not None:
                self._life.call_beside(partial(self._runs.measure, pending, site))
        return answer, record

    def _expect_in_batch(self, runners: Mapping[str, Runner], task: Task, own: Mapping[str, int]) -> Forecast:
        """What a batch is placed by; `own` holds how many of its tasks each site has."""
        runners = {**runners, **self._sites.now}  # a batch may be pinned to a site that has left
        absent = absent_sites(runners, task.kind) if len(own) > 1 else {}
        sites = {one: runners[one] for one in own if one in runners and one not in absent}
        with self._lock:
            memory = self._memories.of(task.kind, runners)
            return self._forecaster.forecast(memory, task, sites, now_s=self._clock.now_s(), own=own)
