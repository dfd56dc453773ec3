"""One task, one way: predict, decide, execute, learn, record."""

import asyncio
import itertools
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Self

from common.errors import BadValue, CloudBroken, CloudError, ConfigError, TaskError
from common.tasks import Kind, Task, kind_of
from common.values import encode
from robot_client import policies, predictors
from robot_client.onboard import OnboardRunner
from robot_client.policies import PINNED, Decision, Forecast, Outlook, Policy
from robot_client.predictors import LEAST_SQUARES, Predictor
from robot_client.runner import CLOUD, ONBOARD, Execution, Runner
from robot_client.trace import Record

BOTH = "both"
TIMEOUT_S = 2.0
TIMEOUT_MAX_S = 24 * 3600.0
WINDOW = 50
POLL_S = 0.01

log = logging.getLogger(__name__)


class Offloader:
    """Runs each task where its policy says, always gets an answer, and learns from what happened.

    `runners` holds one runner a site, onboard among them; `predictor` makes the memory of one kind on one
    site; `observers` are called with the record of every task, in the thread that asked for it. Use it as
    a context manager, from any number of threads.
    """

    def __init__(
        self,
        runners: Sequence[Runner],
        *,
        policy: Policy,
        predictor: Callable[[], Predictor],
        timeout_s: float = TIMEOUT_S,
        observers: Iterable[Callable[[Record], None]] = (),
    ) -> None:
        self._runners = {runner.site: runner for runner in runners}
        if ONBOARD not in self._runners or len(self._runners) != len(runners):
            raise ConfigError(f"sites {[r.site for r in runners]}: each once, {ONBOARD!r} among them")
        self._policy = policy
        self._make_predictor = predictor
        self._timeout_s = _checked_timeout(timeout_s)
        self._observers = tuple(observers)
        self._memories: dict[str, dict[str, _Memory]] = {}
        self._crossed: set[str] = set()  # kinds whose values are known to cross the wire
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._session = secrets.token_hex(4)
        self.last: Record | None = None

    @classmethod
    def connect(
        cls,
        endpoint: str | None = None,
        *,
        sites: dict[str, str] | None = None,
        policy: str = "paper",
        predictor: str = LEAST_SQUARES,
        window: int = WINDOW,
        timeout_s: float = TIMEOUT_S,
        seed: int = 0,
        observers: Iterable[Callable[[Record], None]] = (),
    ) -> Self:
        """Onboard, `cloud` at `endpoint` (tcp://HOST:PORT) and any further named `sites`.

        `seed` is that of predictors that draw.
        """
        from robot_client.cloud import CloudRunner  # zmq is loaded only where a socket is opened

        servers = ({CLOUD: endpoint} if endpoint else {}) | (sites or {})

        def remember() -> Predictor:
            return predictors.make(predictor, window, seed)

        chosen = policies.make(policy)
        remember()  # a wrong name or window is said now, not at the first task
        runners: list[Runner] = []
        try:
            for site, where in servers.items():
                runners.append(CloudRunner(where, site=site))
            runners.append(OnboardRunner())
            return cls(runners, policy=chosen, predictor=remember, timeout_s=timeout_s, observers=observers)
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
        task = Task(kind, args, kind.size_of(args))
        first = kind.name not in self._crossed and len(self._runners) > 1
        if first:
            _check_crosses(kind, "arguments", list(args))
        answer, record = self._offload(task, where, budget_s)
        self.last = record
        self._tell(record)
        if answer.failure is not None:
            raise answer.failure
        if first:
            _check_crosses(kind, "result", answer.value)
            self._crossed.add(kind.name)
        return answer.value

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
        for runner in self._runners.values():
            runner.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _offload(self, task: Task, where: str | None, budget_s: float) -> tuple[Execution, Record]:
        """Predict, decide, execute, learn, record."""
        started_at, started = datetime.now(UTC), time.perf_counter()
        forecast, absent = self._predict(task.kind, task.size)
        decision = self._decide(task.kind, forecast, absent, where)
        executions = self._execute(task, decision, forecast, budget_s)
        answer = _answer(executions)
        self._learn(task, executions)
        number = next(self._numbers)
        record = Record(
            i=number,
            id=f"{self._session}-{number}",
            kind=task.kind.name,
            size=task.size,
            sites=forecast.sites,
            decision=decision,
            executions=tuple(replace(execution, value=None) for execution in executions),
            used=answer.site if answer.ok else None,
            waited_s=time.perf_counter() - started,
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

    def _predict(self, kind: Kind, size: float) -> tuple[Forecast, dict[str, str]]:
        """The outlook of every site that can take the task, and why the others cannot."""
        absent = self._absent(kind)
        with self._lock:
            sites = {
                site: self._memory(kind, site).outlook(size) for site in self._runners if site not in absent
            }
        return Forecast(size, sites), absent

    def _decide(self, kind: Kind, forecast: Forecast, absent: dict[str, str], where: str | None) -> Decision:
        if where is not None:
            return self._pinned(kind, forecast, where)
        if len(forecast.sites) == 1:
            why = "; ".join(f"{site}: {why}" for site, why in absent.items()) or "no other site"
            return Decision(ONBOARD, False, why, "none")
        with self._lock:
            decision = self._policy.decide(forecast)
        if decision.both and not kind.duplicate:
            # Warm-up without running twice: the site that knows least learns next.
            site = min(
                forecast.sites, key=lambda site: (len(self._memory(kind, site).predictor), site != ONBOARD)
            )
            return Decision(site, False, f"{decision.reason}; never on two sites", decision.policy)
        return decision

    def _pinned(self, kind: Kind, forecast: Forecast, where: str) -> Decision:
        if where != BOTH and where not in self._runners:
            raise ConfigError(f"where={where!r} is not one of {', '.join([*self._runners, BOTH])}")
        if where == BOTH and not kind.duplicate:
            raise ConfigError(f"where='both': task {kind.name} is declared duplicate=False")
        if where == BOTH:
            both = len(forecast.sites) > 1
            return Decision(ONBOARD, both, "measured on both" if both else "only onboard was there", PINNED)
        if where not in forecast.sites:
            return Decision(ONBOARD, False, f"pinned to {where}, which cannot take it", PINNED)
        return Decision(where, False, "pinned by the caller", PINNED)

    def _execute(
        self, task: Task, decision: Decision, forecast: Forecast, timeout_s: float
    ) -> tuple[Execution, ...]:
        """Run on the decided sites, in parallel; then onboard, where no site answered and it still may."""
        sites = list(forecast.sites) if decision.both else [decision.site]
        futures = {site: self._runners[site].submit(task, timeout_s) for site in sites}
        executions = [_finished(site, future) for site, future in futures.items()]
        if ONBOARD not in sites and all(_may_fall_back(one, task.kind) for one in executions):
            executions.append(_finished(ONBOARD, self._runners[ONBOARD].submit(task, timeout_s)))
        return tuple(executions)

    def _learn(self, task: Task, executions: Iterable[Execution]) -> None:
        with self._lock:
            memories = self._memories[task.kind.name]
            for memory in memories.values():
                memory.age += 1
            for execution in executions:
                if not isinstance(execution.failure, TaskError):
                    self._memory(task.kind, execution.site).learn(task.size, execution)

    def _memory(self, kind: Kind, site: str) -> "_Memory":
        memories = self._memories.setdefault(kind.name, {})
        if site not in memories:
            memories[site] = _Memory(self._make_predictor())
        return memories[site]


class _Memory:
    """What is known of one kind on one site."""

    def __init__(self, predictor: Predictor) -> None:
        self.predictor = predictor
        self.age = 0
        self._failures = 0

    def outlook(self, size: float) -> Outlook:
        prediction = self.predictor.predict(size, self.age + 1)
        return Outlook(
            predicted_s=prediction.seconds if prediction else None,
            spread_s=prediction.spread_s if prediction else None,
            full=self.predictor.full,
            age=self.age,
            failures=self._failures,
        )

    def learn(self, size: float, execution: Execution) -> None:
        # A failed run is learnt as the time until it was given up: the one addition to Algorithm 1.
        self.predictor.learn(size, execution.seconds)
        self._failures = 0 if execution.ok else self._failures + 1
        self.age = 0


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


def _finished(site: str, future: "Future[Execution]") -> Execution:
    """A runner's future ends by itself within the budget; one cancelled by `close` counts as broken."""
    try:
        return future.result()
    except CancelledError:
        return Execution(site, 0.0, failure=CloudBroken("closed while the task was in flight"))


def _may_fall_back(execution: Execution, kind: Kind) -> bool:
    return isinstance(execution.failure, CloudError) and (kind.duplicate or not execution.started)


def _answer(executions: tuple[Execution, ...]) -> Execution:
    """The first good answer; else the task's own failure; else whatever failed last."""
    for execution in executions:
        if isinstance(execution.failure, BadValue):
            return execution
    good = [execution for execution in executions if execution.ok]
    if good:
        return min(good, key=lambda execution: execution.seconds)
    own = [execution for execution in executions if isinstance(execution.failure, TaskError)]
    return (own or list(executions))[-1]
