"""One task, one way: predict, decide, execute, learn, record."""

import asyncio
import itertools
import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Self

from offboard.common.errors import BadValue, ConfigError, Overtaken
from offboard.common.tasks import Kind, Task, kind_of
from offboard.common.wire.values import encode
from offboard.robot_client import policies, predictors
from offboard.robot_client.execution.batch import Batch, Placed, arguments
from offboard.robot_client.execution.race import Plan, Race, answer_of
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.lessons import Asked, Learning
from offboard.robot_client.learning.store import Store
from offboard.robot_client.policies import PINNED, Decision, Forecast, Outlook, Policy, objectives
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.objectives import Objective
from offboard.robot_client.predictors import Predictor
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.records.trace import Late, Record
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.clock import Clock, SystemClock
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import (
    CLOUD,
    ONBOARD,
    TIMEOUT_S,
    UNMEASURED,
    Condition,
    Execution,
    Runner,
)

BOTH = "both"
TIMEOUT_MAX_S = 24 * 3600.0
POLL_S = 0.01
LATE_MAX = 64  # executions that ended after their task, kept for the next record
OVERDUE = 0.5  # of the time it took so far: what a task that should be done is taken to need still

log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Flight:
    """A run under way on a site."""

    began_s: float
    predicted_s: float

    def left_s(self, now_s: float) -> float:
        """What it is taken to need still."""
        so_far_s = now_s - self.began_s
        return max(self.predicted_s - so_far_s, OVERDUE * so_far_s)


class Offloader:
    """Runs each task where its policy says, always gets an answer, and learns from what happened.

    `runners` holds one runner a site, onboard among them; `predictor` makes the memory of one kind on one
    site; with `shared_work` sites learn seconds per work where a kind tells its work. `observers` are called
    with the record of every task, in the thread that asked for it; what is learnt outlives the process in
    `store`. Use it as a context manager, from any number of threads.
    """

    def __init__(
        self,
        runners: Sequence[Runner],
        *,
        policy: Policy,
        predictor: Callable[[], Predictor],
        shared_work: bool = False,
        objective: Objective | None = None,
        energy: Energy | None = None,
        allowance: Allowance | None = None,
        timeout_s: float = TIMEOUT_S,
        observers: Iterable[Callable[[Record], None]] = (),
        clock: Clock | None = None,
        store: Store | None = None,
    ) -> None:
        self._runners = {runner.site: runner for runner in runners}
        if ONBOARD not in self._runners or len(self._runners) != len(runners):
            raise ConfigError(f"sites {[r.site for r in runners]}: each once, {ONBOARD!r} among them")
        self._policy = policy
        self._remember = partial(
            KindMemory,
            make=predictor,
            objective=objective or objectives.Mean(),
            energy=energy or Energy(),
            shared_work=shared_work,
        )
        self._allowance = allowance or Allowance()
        self._timeout_s = _checked_timeout(timeout_s)
        self._observers = tuple(observers)
        self._clock = clock or SystemClock()
        self._store = store
        self._memories: dict[str, KindMemory] = {}
        self._flights: dict[str, dict[int, _Flight]] = {site: {} for site in self._runners}
        self._learning = Learning(self._runners, self._allowance)
        self._late: deque[Late] = deque(maxlen=LATE_MAX)
        self._crossed: set[str] = set()  # kinds whose values are known to cross the wire
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._session = secrets.token_hex(4)
        self._closed = False
        self.last: Record | None = None

    @classmethod
    def connect(
        cls,
        endpoint: str | None = None,
        *,
        sites: dict[str, str] | None = None,
        policy: str = policies.DEFAULT,
        predictor: str | None = None,
        window: int = WINDOW,
        timeout_s: float = TIMEOUT_S,
        seed: int = 0,
        objective: Objective | None = None,
        energy: Energy | None = None,
        allowance: Allowance | None = None,
        observers: Iterable[Callable[[Record], None]] = (),
        memory: Path | None = None,
        keys: Path | str | None = None,
    ) -> Self:
        """Onboard, `cloud` at `endpoint` (tcp://HOST:PORT) and any further named `sites`.

        `predictor` (None: the one that the policy is meant with) may begin with `work:`, for times per work.
        `seed` is that of policies and predictors that draw. `memory`: the file in which what was learnt
        outlives the process. Caps in the allowance put `budget` around the policy. `keys`: the folder of
        `robot-client keys` with the public key of each server, NAME.key or server.key (None: no encryption).
        """
        from offboard.common.security.keys import robot_keys  # zmq is loaded only where a socket is opened
        from offboard.robot_client.sites.cloud import CloudRunner

        servers = ({CLOUD: endpoint} if endpoint else {}) | (sites or {})
        if allowance is not None and allowance.capped and "budget" not in policy.split(":"):
            policy = f"budget:{policy}"
        chosen = policies.make(policy, seed)
        name = policies.predictor_of(policy) if predictor is None else predictor
        plain = name.removeprefix(predictors.WORK)

        def remember() -> Predictor:
            return predictors.make(plain, window, seed)

        remember()  # a wrong name or window is said now, not at the first task
        store = None if memory is None else Store(memory)
        heartbeat_s = heartbeat.EVERY_S if predictors.conditional(plain) else 0.0
        runners: list[Runner] = []
        try:
            for site, where in servers.items():
                own = None if keys is None else robot_keys(Path(keys), site)
                runners.append(CloudRunner(where, site=site, heartbeat_s=heartbeat_s, seed=seed, keys=own))
            runners.append(OnboardRunner())
            return cls(
                runners,
                policy=chosen,
                predictor=remember,
                shared_work=name != plain,
                objective=objective,
                energy=energy,
                allowance=allowance,
                timeout_s=timeout_s,
                observers=observers,
                store=store,
            )
        except ConfigError:
            for runner in runners:
                runner.close()
            raise

    def __call__(
        self,
        function: Callable[..., Any],
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        **kwargs: Any,
    ) -> Any:
        """Run a `@task` function and return its result; TaskFailed where the function itself raised.

        `where` pins the call to a site, or to `both` for measuring; `timeout_s` bounds the wait for a
        remote site, after which the task runs onboard.
        """
        budget_s = self._timeout_s if timeout_s is None else _checked_timeout(timeout_s)
        kind = kind_of(function)
        args = kind.bind(args, kwargs)
        answer, _ = self._answer(where, budget_s, Task(kind, args, kind.size_of(args)))
        if answer.failure is not None:
            raise answer.failure
        return answer.value

    def map(
        self,
        function: Callable[..., Any],
        items: Iterable[Any],
        *,
        where: str | None = None,
        timeout_s: float | None = None,
    ) -> list[Any]:
        """Run a `@task` function on every item, on all sites at once so that the last one ends soonest.

        An item is the argument, or a tuple of all of them where the function takes several. The results come
        in the order of the items; where tasks fail, the first one's error is raised once all have ended.
        `where` and `timeout_s` are those of a single call. Observers are called in threads of the batch.
        """
        budget_s = self._timeout_s if timeout_s is None else _checked_timeout(timeout_s)
        kind = kind_of(function)
        tasks = [Task(kind, args, kind.size_of(args)) for args in arguments(kind, items)]
        sites = tuple(self._runners)
        if where is not None:
            self._check_where(kind, where)
            sites = (ONBOARD if where == BOTH else where,)
        batch = Batch(
            tasks,
            sites,
            predict=partial(self._expect, kind, sites, budget_s),
            run=partial(self._answer, where, budget_s),
            clock=self._clock,
            timeout_s=budget_s,
        )
        return batch.run()

    async def run(self, function: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """The same for asyncio; the event loop is free meanwhile."""
        return await asyncio.to_thread(self, function, *args, **options)

    def wait_for_sites(self, function: Callable[..., Any], timeout_s: float) -> dict[str, str]:
        """Wait until every site can take this task; after `timeout_s` says why the remaining ones cannot."""
        kind, until = kind_of(function), time.monotonic() + timeout_s
        while True:
            absent = self._absent(kind)
            if not absent or time.monotonic() >= until:
                return absent
            time.sleep(POLL_S)

    def close(self) -> None:
        """Safe to call twice."""
        with self._lock:
            if not self._closed:
                self._learning.catch_up()
            last = None if self._closed or self._store is None else self._store.snapshot(self._memories)
            self._closed = True
        for runner in self._runners.values():
            runner.close()
        if last is not None and self._store is not None:
            self._store.save_last(last)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(
        self, where: str | None, budget_s: float, task: Task, placed: Placed | None = None
    ) -> tuple[Execution, Record]:
        """One task from its arguments to its record; `placed` stands for the policy."""
        kind = task.kind
        first = kind.name not in self._crossed and len(self._runners) > 1
        if first:
            _check_crosses(kind, "arguments", list(task.args))
        answer, record = self._offload(task, where, budget_s, placed)
        self.last = record
        self._tell(record)
        if first and answer.failure is None:
            _check_crosses(kind, "result", answer.value)
            self._crossed.add(kind.name)
        return answer, record

    def _offload(
        self, task: Task, where: str | None, budget_s: float, placed: Placed | None
    ) -> tuple[Execution, Record]:
        """Predict, decide, execute, learn, record."""
        started_at, started = datetime.now(UTC), self._clock.now_s()
        number = next(self._numbers)
        absent = self._absent(task.kind)
        with self._lock:
            asked = self._ask(task, f"{self._session}-{number}", absent, where, budget_s, placed)
        executions = self._execute(asked, budget_s, placed.call if placed else None)
        answer = answer_of(executions)
        with self._lock:
            self._learn(asked, executions)
            if self._store is not None and not self._closed and self._store.due(self._clock.now_s()):
                self._learning.catch_up()
                self._store.save_soon(self._store.snapshot(self._memories))
            late, regret = tuple(self._late), self._learning.regret.estimate()
            self._late.clear()
        record = Record(
            i=number,
            id=asked.id,
            kind=task.kind.name,
            size=task.size,
            sites=asked.forecast.sites,
            decision=asked.decision,
            executions=tuple(execution.without_value() for execution in executions),
            used=answer.site if answer.ok else None,
            waited_s=self._clock.now_s() - started,
            amount=asked.amount,
            late=late,
            regret=regret,
            started_at=started_at,
        )
        return answer, record

    def _tell(self, record: Record) -> None:
        """An observer that fails must not cost the caller its answer."""
        for observe in self._observers:
            try:
                observe(record)
            except Exception:  # an observer is the user's own code
                log.exception("observer %r failed on task %d", observe, record.i)

    def _absent(self, kind: Kind) -> dict[str, str]:
        return {site: why for site, runner in self._runners.items() if (why := runner.unavailable(kind))}

    def _ask(
        self,
        task: Task,
        id: str,
        absent: dict[str, str],
        where: str | None,
        timeout_s: float,
        placed: Placed | None,
    ) -> Asked:
        """Predict and decide."""
        self._allowance.begin(self._clock.now_s())
        memory = self._memory(task.kind)
        amount = memory.amount(task.size)
        outlooks = {
            site: self._outlook(memory, site, amount, timeout_s)
            for site in self._runners
            if site not in absent
        }
        forecast = self._forecast(task.kind, memory, task.size, outlooks)
        decision = self._decide(task.kind, forecast, absent, where, placed or self._policy)
        if where is None and placed is None and decision.site != memory.last_site:
            if memory.last_site is not None:
                log.info("%s moves to %s: %s", task.kind.name, decision.site, decision.reason)
            memory.last_site = decision.site
        return Asked(task, id, memory, forecast, amount, decision)

    def _forecast(
        self, kind: Kind, memory: KindMemory, size: float, outlooks: Mapping[str, Outlook]
    ) -> Forecast:
        return Forecast(
            size=size,
            sites=outlooks,
            last_site=memory.last_site,
            duplicates=self._allowance.duplicates if kind.duplicate else 0.0,
            bytes_left=self._allowance.bytes_left,
            joules_left=self._allowance.joules_left,
        )

    def _outlook(self, memory: KindMemory, site: str, amount: float | None, timeout_s: float) -> Outlook:
        here, flights = memory.site(site), self._flights[site]
        condition = UNMEASURED
        if here.conditional:
            condition = self._measured(site)
            if flights:
                condition = self._behind_own(site, condition)
        return here.outlook(amount, condition, in_flight=len(flights), timeout_s=timeout_s)

    def _behind_own(self, site: str, condition: Condition) -> Condition:
        """Onboard runs one task at a time; a server's queue may not know yet of what was sent to it."""
        flights = self._flights[site].values()
        if site != ONBOARD:
            return condition._replace(queue=max(condition.queue, len(flights)))
        now_s = self._clock.now_s()
        left_s = [one.left_s(now_s) for one in flights]
        return condition._replace(wait_s=sum(left_s))

    def _decide(
        self, kind: Kind, forecast: Forecast, absent: dict[str, str], where: str | None, policy: Policy
    ) -> Decision:
        if where is not None:
            return self._pinned(kind, forecast, where)
        if len(forecast.sites) == 1:
            why = "; ".join(f"{site}: {why}" for site, why in absent.items()) or "no other site"
            return Decision(ONBOARD, why, "none")
        decision = policy.decide(forecast)
        if decision.both and not kind.duplicate:
            # Warm-up without running twice: the site that knows least learns next.
            memory = self._memory(kind)
            heard = [site for site in forecast.sites if site not in decision.spared]
            site = min(heard, key=lambda site: (len(memory.site(site).predictor), site != ONBOARD))
            return Decision(site, f"{decision.reason}; never on two sites", decision.policy)
        if decision.second is not None and not kind.duplicate:
            return replace(decision, second=None)
        return decision

    def _expect(
        self, kind: Kind, sites: Sequence[str], timeout_s: float, size: float, own: Mapping[str, int]
    ) -> Forecast:
        """What a batch is placed by: the wait for its own tasks, so many on each site, is left out."""
        absent = self._absent(kind) if len(sites) > 1 else {}
        with self._lock:
            memory = self._memory(kind)
            amount, outlooks = memory.amount(size), {}
            for site in sites:
                if site not in absent:
                    here, measured = memory.site(site), self._apart_from(own[site], memory, site)
                    outlooks[site] = here.outlook(amount, measured, in_flight=own[site], timeout_s=timeout_s)
            return self._forecast(kind, memory, size, outlooks)

    def _apart_from(self, own: int, memory: KindMemory, site: str) -> Condition:
        if not memory.site(site).conditional:
            return UNMEASURED
        condition = self._measured(site)
        return condition._replace(queue=max(0, condition.queue - own))

    def _measured(self, site: str) -> Condition:
        """Of a server too the load of the robot, where that is what its times tell of."""
        condition = self._runners[site].condition()
        if site != ONBOARD and (load := self._learning.load(site)):
            return condition._replace(load=load)
        return condition

    def _check_where(self, kind: Kind, where: str) -> None:
        if where != BOTH and where not in self._runners:
            raise ConfigError(f"where={where!r} is not one of {', '.join([*self._runners, BOTH])}")
        if where == BOTH and not kind.duplicate:
            raise ConfigError(f"where='both': task {kind.name} is declared duplicate=False")

    def _pinned(self, kind: Kind, forecast: Forecast, where: str) -> Decision:
        self._check_where(kind, where)
        if where == BOTH:
            both = len(forecast.sites) > 1
            why = "measured on both" if both else "only onboard was there"
            return Decision(ONBOARD, why, PINNED, both=both)
        if where not in forecast.sites:
            return Decision(ONBOARD, f"pinned to {where}, which cannot take it", PINNED)
        return Decision(where, "pinned by the caller", PINNED)

    def _execute(self, asked: Asked, timeout_s: float, call: "Future[str] | None") -> tuple[Execution, ...]:
        decision, sites = asked.decision, asked.forecast.sites
        race = Race(
            asked.task,
            self._runners,
            self._clock,
            timeout_s,
            begun=partial(self._begun, asked),
            allowed=self._take_duplicate,
            late=partial(self._ended_late, asked),
            meanwhile=self._meanwhile,
        )
        first: tuple[str, ...] = (decision.site,)
        if decision.both:
            first = tuple(site for site in sites if site not in decision.spared)
            if decision.policy != PINNED:  # measuring is the caller's choice, not the policy's
                self._take_duplicates(len(first) - 1)
        try:
            return race.run(Plan(first, decision.second, all=decision.both, call=call))
        except BaseException:  # closed meanwhile, or Ctrl-C: whatever still runs is nobody's
            with self._lock:
                for flights in self._flights.values():
                    flights.pop(asked.task.id, None)
            raise

    def _begun(self, asked: Asked, site: str) -> None:
        outlook = asked.forecast.sites.get(site)
        predicted_s = (outlook.predicted_s if outlook else None) or 0.0
        with self._lock:
            self._flights[site][asked.task.id] = _Flight(self._clock.now_s(), predicted_s)

    def _take_duplicates(self, count: int) -> None:
        with self._lock:
            for _ in range(count):
                self._allowance.duplicate()

    def _take_duplicate(self) -> bool:
        """Whether a second run may begin; it is then counted. A fallback needs no leave and is none."""
        with self._lock:
            allowed = self._allowance.duplicates >= 1
            if allowed:
                self._allowance.duplicate()
            return allowed

    def _learn(self, asked: Asked, executions: Sequence[Execution]) -> None:
        """What has ended by now."""
        for one in executions:
            if not isinstance(one.failure, Overtaken):
                self._flights[one.site].pop(asked.task.id, None)
        if not self._closed:  # what was given up at the end says nothing of the site
            self._learning.learn(asked, executions)

    def _ended_late(self, asked: Asked, site: str, execution: Execution) -> None:
        """A run that came second has ended; called in any thread."""
        with self._lock:
            self._late.append(Late(asked.id, site, execution.seconds, execution.ok, execution.censored))
            self._flights[site].pop(asked.task.id, None)
            if execution.started and not self._closed:
                self._learning.learn_late(asked, execution)

    def _meanwhile(self) -> None:
        """A task is under way."""
        with self._lock:
            if not self._closed:
                self._learning.between()

    def _memory(self, kind: Kind) -> KindMemory:
        if kind.name not in self._memories:
            memory = self._memories[kind.name] = self._remember(kind)
            if self._store is not None:
                self._store.recall(memory, self._runners.keys())
        return self._memories[kind.name]


def _check_crosses(kind: Kind, what: str, value: Any) -> None:
    """BadValue at the first call, wherever it runs, and not at the first one that goes to a server."""
    try:
        encode(value, kind.types)
    except BadValue as error:
        raise BadValue(f"{what} of task {kind.name}: {error}") from error


def _checked_timeout(timeout_s: float) -> float:
    if not 0 < timeout_s <= TIMEOUT_MAX_S:
        raise ConfigError(f"timeout_s {timeout_s}: must be above 0 and at most {TIMEOUT_MAX_S:g}")
    return timeout_s
