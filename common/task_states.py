"""Owns what `@task(setup=...)` makes, such as a model: one state for each kind and worker."""

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from offboard.common.errors import TaskFailed, describe, is_interrupt
from offboard.common.task_call import traceback_of
from offboard.common.tasks import Kind

SETUP_AGAIN_S = 30.0  # after a setup has raised; until then, its error is the answer of each call
SETUPS_MAX = 64  # setups whose times are remembered: more than the tasks of one queue can wait for

_NOTHING: AbstractContextManager[tuple[Any, ...]] = nullcontext(())  # shared: most kinds have no setup


@dataclass(eq=False, slots=True)
class _Setup:
    began_s: float
    ended_s: float = float("inf")


@dataclass(eq=False, slots=True)
class _Loan:
    """A state that the task which runs here has. `nested` is held by a call of the same kind that it makes.

    `outer`: the loan of the task that called this one.
    """

    states: "TaskStates"
    kind: str
    state: Any
    outer: "_Loan | None"
    nested: threading.Lock = field(default_factory=threading.Lock)


_loan: ContextVar[_Loan | None] = ContextVar("loan", default=None)


class TaskStates:
    """The states of `workers` workers, which run one task each at a time. Any thread may call any method.

    A state serves one task at a time, and calls of the same kind that this task makes. The next task may use
    it in another thread.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._free: defaultdict[str, list[Any]] = defaultdict(list)  # by kind, as the next two
        self._made: Counter[str] = Counter()  # with those that are being made
        self._making: Counter[str] = Counter()
        self._failed: dict[str, tuple[TaskFailed, float]] = {}  # the last setup raised; until when that holds
        self._setups: deque[_Setup] = deque(maxlen=SETUPS_MAX)
        self._changed = threading.Condition()

    def prepare(self, kind: Kind) -> None:
        """Make the missing states of a kind. TaskFailed if its setup raises; one that did is tried again."""
        with self._changed:
            self._failed.pop(kind.name, None)
        while kind.setup is not None and not self.ready(kind):
            with self._changed:
                if self._made[kind.name] == self._workers:
                    self._changed.wait()  # another thread makes the last one
                    continue
                self._reserve(kind)
            self._give_back(kind, self._make(kind))

    def ready(self, kind: Kind) -> bool:
        """Whether each worker has its state of this kind."""
        name = kind.name
        with self._changed:
            return kind.setup is None or (self._made[name] == self._workers and not self._making[name])

    def lend(self, kind: Kind) -> AbstractContextManager[tuple[Any, ...]]:
        """The arguments that come before those of the caller: a state, or nothing if the kind has no setup.

        If no state is free, it is made now, or else the call waits for one. TaskFailed if the setup raises,
        or has raised in the last SETUP_AGAIN_S.
        """
        return _NOTHING if kind.setup is None else self._lent(kind)

    @contextmanager
    def _lent(self, kind: Kind) -> Iterator[tuple[Any, ...]]:
        outer = caller = _loan.get()
        while caller is not None and (caller.states is not self or caller.kind != kind.name):
            caller = caller.outer
        with nullcontext() if caller is None else caller.nested:
            state = self._take(kind) if caller is None else caller.state
            token = _loan.set(_Loan(self, kind.name, state, outer))
            try:
                yield (state,)
            finally:
                _loan.reset(token)
                if caller is None:
                    self._give_back(kind, state)

    def call(self, kind: Kind, args: Sequence[Any]) -> Any:
        with self.lend(kind) as state:
            return kind.function(*state, *args)

    def setup_s(self, since_s: float, until_s: float) -> float:
        """The part of this time in which a setup ran, in seconds. The clock is `time.perf_counter`."""
        if not self._setups:
            return 0.0
        total_s, counted_s = 0.0, since_s
        with self._changed:
            setups = sorted(self._setups, key=lambda setup: setup.began_s)
        for setup in setups:
            began_s, ended_s = max(setup.began_s, counted_s), min(setup.ended_s, until_s)
            if ended_s > began_s:
                total_s, counted_s = total_s + ended_s - began_s, ended_s
        return total_s

    def _take(self, kind: Kind) -> Any:
        with self._changed:
            while not self._free[kind.name]:
                failure, until_s = self._failed.get(kind.name, (None, 0.0))
                if failure is None or time.perf_counter() >= until_s:
                    if self._made[kind.name] < self._workers:
                        self._reserve(kind)
                        break
                elif not self._made[kind.name]:
                    raise TaskFailed(str(failure), failure.traceback) from failure.__cause__
                self._changed.wait()
            else:
                return self._free[kind.name].pop()
        return self._make(kind)

    def _reserve(self, kind: Kind) -> None:
        self._made[kind.name] += 1
        self._making[kind.name] += 1

    def _make(self, kind: Kind) -> Any:
        assert kind.setup is not None
        setup, made = _Setup(time.perf_counter()), False
        failure: TaskFailed | None = None
        with self._changed:
            self._setups.append(setup)
        try:
            state = kind.setup()
            made = True
        except BaseException as error:
            if is_interrupt(error):
                raise
            text = f"setup of task {kind.name}: {describe(error)}"
            failure = TaskFailed(text, traceback_of(error, TaskStates._make))
            raise failure from error
        finally:
            setup.ended_s = time.perf_counter()
            with self._changed:
                if failure is not None:
                    self._failed[kind.name] = failure, setup.ended_s + SETUP_AGAIN_S
                self._making[kind.name] -= 1
                self._made[kind.name] -= not made
                self._changed.notify_all()
        return state

    def _give_back(self, kind: Kind, state: Any) -> None:
        with self._changed:
            self._free[kind.name].append(state)
            self._changed.notify_all()
