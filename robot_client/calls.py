"""The ways to call a task: at once, with its record, in another thread, in asyncio, and as a stream.

How a call is answered is in `offloader`. The overloads let type checkers find wrong arguments; with an option
they check none, as PEP 612 allows no further keywords next to those of the task.
"""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast, overload

from offboard.common.source.comparison import kind_in_use
from offboard.common.tasks import PlainTask, SetupTask, Task
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.lifetime import Lifetime
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.outgoing import new_task
from offboard.robot_client.sites.runner import Execution, checked_timeout
from offboard.robot_client.sites.waiting import Clock
from offboard.robot_client.streams.action_stream import ActionStream, Ask, OnEmpty
from offboard.robot_client.streams.asking import BLEND, MISS_RATE, Pace
from offboard.robot_client.streams.counts import StreamMetrics
from offboard.robot_client.streams.stream_calls import StreamCalls

P = ParamSpec("P")
R = TypeVar("R")
Seconds: TypeAlias = float | None
Options: TypeAlias = tuple[str | None, Seconds, Seconds]  # where, timeout_s and deadline_s


class Calls:
    """The calls of an offloader, which answers them."""

    steps_itself = False  # in virtual time
    _clock: Clock
    _life: Lifetime
    _memories: Memories
    _sites: PresentSites
    _streams: StreamMetrics

    @overload
    def __call__(
        self, function: Callable[..., R], /, *args: Any,
        where: str | None, timeout_s: Seconds = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    def __call__(
        self, function: Callable[..., R], /, *args: Any,
        timeout_s: Seconds, where: str | None = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    def __call__(
        self, function: Callable[..., R], /, *args: Any,
        deadline_s: Seconds, where: str | None = ..., timeout_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    def __call__(self, function: SetupTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R: ...
    @overload
    def __call__(self, function: PlainTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R: ...
    def __call__(  # type: ignore[misc]  # PEP 612 names no keyword beside P.kwargs
        self,
        function: Callable[..., R],
        /,
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        deadline_s: float | None = None,
        **kwargs: Any,
    ) -> R:
        """Run a `@task` function and return its result; TaskFailed if the function itself raised.

        `where` pins the call to a site, or to `both` to measure all of them. `timeout_s` bounds the wait for
        a remote site, after which the task runs onboard. `deadline_s` bounds the wait of the caller: after
        it the call raises DeadlineMissed, and the task runs to its end in another thread.

        Every error that a call raises has its `record`, if it got so far.
        """
        return self._call(function, args, kwargs, options=(where, timeout_s, deadline_s))[0]

    @overload
    def call(
        self, function: Callable[..., R], /, *args: Any,
        where: str | None, timeout_s: Seconds = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> tuple[R, Record]: ...  # fmt: skip
    @overload
    def call(
        self, function: Callable[..., R], /, *args: Any,
        timeout_s: Seconds, where: str | None = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> tuple[R, Record]: ...  # fmt: skip
    @overload
    def call(
        self, function: Callable[..., R], /, *args: Any,
        deadline_s: Seconds, where: str | None = ..., timeout_s: Seconds = ..., **kwargs: Any,
    ) -> tuple[R, Record]: ...  # fmt: skip
    @overload
    def call(self, function: SetupTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> tuple[R, Record]: ...
    @overload
    def call(self, function: PlainTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> tuple[R, Record]: ...
    def call(  # type: ignore[misc]  # PEP 612 names no keyword beside P.kwargs
        self,
        function: Callable[..., R],
        /,
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        deadline_s: float | None = None,
        **kwargs: Any,
    ) -> tuple[R, Record]:
        """The same call; returns the result and the record of the call."""
        return self._call(function, args, kwargs, options=(where, timeout_s, deadline_s))

    @overload
    def submit(
        self, function: Callable[..., R], /, *args: Any,
        where: str | None, timeout_s: Seconds = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> CallFuture[R]: ...  # fmt: skip
    @overload
    def submit(
        self, function: Callable[..., R], /, *args: Any,
        timeout_s: Seconds, where: str | None = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> CallFuture[R]: ...  # fmt: skip
    @overload
    def submit(
        self, function: Callable[..., R], /, *args: Any,
        deadline_s: Seconds, where: str | None = ..., timeout_s: Seconds = ..., **kwargs: Any,
    ) -> CallFuture[R]: ...  # fmt: skip
    @overload
    def submit(self, function: SetupTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> CallFuture[R]: ...
    @overload
    def submit(self, function: PlainTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> CallFuture[R]: ...
    def submit(  # type: ignore[misc]  # PEP 612 names no keyword beside P.kwargs
        self,
        function: Callable[..., R],
        /,
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        deadline_s: float | None = None,
        **kwargs: Any,
    ) -> CallFuture[R]:
        """The same call in another thread: returns the future of its result at once.

        At most ASYNC_CALLS_MAX calls are made at a time; further ones wait. `deadline_s` counts from when a
        call begins. `cancel` of the future ends the call at any time: a run that waits is withdrawn, one that
        has begun is asked to stop (`check_wanted`). A native function cannot be stopped: onboard it goes on
        at a low priority. `record` of the future is there when it is done.
        """
        self._life.refuse_in_fork()
        options = (where, timeout_s, deadline_s)
        return self._submit(function, args, kwargs, options=options, future=CallFuture[R]())

    @overload
    async def run(
        self, function: Callable[..., R], /, *args: Any,
        where: str | None, timeout_s: Seconds = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    async def run(
        self, function: Callable[..., R], /, *args: Any,
        timeout_s: Seconds, where: str | None = ..., deadline_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    async def run(
        self, function: Callable[..., R], /, *args: Any,
        deadline_s: Seconds, where: str | None = ..., timeout_s: Seconds = ..., **kwargs: Any,
    ) -> R: ...  # fmt: skip
    @overload
    async def run(self, function: SetupTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R: ...
    @overload
    async def run(self, function: PlainTask[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R: ...
    async def run(  # type: ignore[misc]  # PEP 612 names no keyword beside P.kwargs
        self,
        function: Callable[..., R],
        /,
        *args: Any,
        where: str | None = None,
        timeout_s: float | None = None,
        deadline_s: float | None = None,
        **kwargs: Any,
    ) -> R:
        """The same call for asyncio, as with `submit`; the event loop is free while the task runs.

        If the caller is cancelled, so is the call.
        """
        call = self.submit(function, *args, where=where, timeout_s=timeout_s, deadline_s=deadline_s, **kwargs)
        return await asyncio.wrap_future(call)

    def stream(
        self,
        function: Callable[..., Any],
        *,
        hz: float,
        horizon: int,
        calls_per_s: float | None = None,
        miss_rate: float = MISS_RATE,
        actions: Callable[[Any], Any] | None = None,
        ask: Ask | None = None,
        blend: int = BLEND,
        on_empty: OnEmpty = "last",
    ) -> ActionStream:
        """Play the actions of a policy at `hz` steps a second, and ask for the next chunk in time.

        `function`: a `@task` that maps an observation to a chunk of about `horizon` actions.
        `calls_per_s`: the limit of questions to each site per second (None: CALLS_PER_HORIZON in a horizon).
        `miss_rate`: the share of chunks that may come later than forecast.
        `actions`: makes an array (steps, dimensions) of an answer (None: `answer["actions"]`, or the answer).
        `ask`: makes the argument, or the tuple of all arguments, of the observation, of the steps that the
        answer should take, and of the actions that are played meanwhile (None: the observation is it).
        `blend`: over how many steps the old actions turn into the new ones; 0: at once.
        `on_empty`: the action of an empty queue: `last`, `zeros`, or what this function returns.
        """
        self._life.refuse_in_fork()
        kind, pace = kind_in_use(function), Pace(hz, horizon, calls_per_s, miss_rate)
        calls = StreamCalls(
            kind,
            self._clock,
            sites=lambda: self._sites.now,
            lost_s=self._memories.lost_s,
            submit=lambda args, site, timeout_s, future: self._submit(
                function, args, {}, options=(site, timeout_s, None), future=future
            ),
            closed=lambda: self._life.closed,
            refuse_in_fork=self._life.refuse_in_fork,
            steps_itself=self.steps_itself,
        )
        stream = ActionStream(
            kind.name, calls, pace, actions=actions, ask=ask, blend=blend, on_empty=on_empty
        )
        self._streams.watch(kind.name, stream.counts)
        return stream

    def _submit(
        self,
        function: Callable[..., R],
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        *,
        options: Options,
        future: CallFuture[R],
    ) -> CallFuture[R]:
        call = partial(self._call, function, args, kwargs, options=options, caller=future)
        self._life.call_in_thread(partial(_value_for, future, call), future)
        return future

    def _call(
        self,
        function: Callable[..., R],
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        *,
        options: Options,
        caller: CallFuture[Any] | None = None,
    ) -> tuple[R, Record]:
        """One call. `caller`: its future, which may cancel it."""
        self._life.refuse_in_fork()
        kind = kind_in_use(function)
        task = new_task(kind, kind.bind(args, kwargs))
        if caller is not None and caller.useful_s is not None:
            task, _ = self._hurried(task, caller.useful_s)
        answer, record = self._answer_call(task, options, caller)
        if answer.failure is not None:
            answer.failure.record = record
            raise answer.failure
        return cast("R", answer.value), record

    def _hurried(self, task: Task, deadline_s: float) -> tuple[Task, float]:
        """The same task, whose answer is useless after this time, and the time as a float."""
        within_s = checked_timeout(deadline_s, "deadline_s")
        return replace(task, useless_s=self._clock.now_s() + within_s), within_s

    def _answer_call(
        self, task: Task, options: Options, caller: CallFuture[Any] | None
    ) -> tuple[Execution, Record]:
        raise NotImplementedError


def _value_for(future: CallFuture[R], call: Callable[[], tuple[R, Record]]) -> R:
    """Make the call of this future."""
    try:
        return call()[0]
    finally:
        future.keep(None)  # if it did not get as far as a record
