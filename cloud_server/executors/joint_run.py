"""One call of a function for several requests, as `Together` of a task asks for."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from offboard.cloud_server.executors.executor import Call, Outcome, arguments, run_task, traceback_in
from offboard.common import cpu_time, tasks
from offboard.common.errors import Unwanted, describe
from offboard.common.task_call import call_while
from offboard.common.task_states import TaskStates
from offboard.common.together import Together
from offboard.common.wire.values import encode


def run_joint(call: Call, states: TaskStates) -> Outcome:
    """Run this call, and with it those that run together with it; their outcomes are in `more`."""
    first, *more = JointRun([call, *call.more], states).outcomes()
    first.more = more
    return first


class JointRun:
    """Calls of one kind that begin together. Each gets an outcome of its own.

    A call whose arguments cannot be read, or whose key is not that of most, does not take part. If the
    function raises or returns no list of results, each call is run alone, one after the other; those of a
    kind that must not run twice fail.
    """

    def __init__(self, calls: Sequence[Call], states: TaskStates) -> None:
        self._calls, self._states = calls, states
        self._kind = tasks.kind_named(calls[0].kind)
        self._began_s = time.perf_counter()
        self._cpu_s = cpu_time.used_s()
        self._done: dict[int, Outcome] = {}  # by the number of the call
        self._note = ""

    def outcomes(self) -> list[Outcome]:
        """Run all calls; the outcome of each, in their order."""
        together = self._kind.together
        if together is not None:
            items = self._read(together)
            if len(items) > 1:
                self._run(together, items)
        for number, call in enumerate(self._calls):
            if number not in self._done:
                self._done[number] = self._alone(call)
        return [self._done[number] for number in range(len(self._calls))]

    def _read(self, together: Together) -> dict[int, tuple[Any, ...]]:
        """The arguments of the calls that take part: those with the key that most of them have."""
        read: dict[int, tuple[Any, ...]] = {}
        keys: dict[int, str] = {}
        for number, call in enumerate(self._calls):
            try:
                args = tuple(arguments(self._kind, call))
                keys[number] = together.key_of(args)
            except Exception:  # noqa: BLE001 - what it is, its own run says
                continue
            read[number] = args
        usual = Counter(keys.values()).most_common(1)
        return {number: args for number, args in read.items() if keys[number] == usual[0][0]}

    def _run(self, together: Together, items: dict[int, tuple[Any, ...]]) -> None:
        kind = self._kind
        wanted = [self._calls[number].wanted for number in items]
        given = [args[0] if kind.positional == 1 else args for args in items.values()]
        in_task = False
        try:
            with self._states.lend(kind) as state:
                in_task = True
                values = call_while(_any_of(wanted), together.function, (*state, given))
                in_task = False
            if not isinstance(values, list | tuple) or len(values) != len(items):
                found = len(values) if isinstance(values, list | tuple) else f"a {type(values).__name__}"
                raise TypeError(f"together of {kind.name} returned {found}, not {len(items)} results")
        except BaseException as error:  # noqa: BLE001 - a task may raise anything
            self._failed(error, items, in_task=in_task)
            return
        run_s, cpu_s = time.perf_counter() - self._began_s, (cpu_time.used_s() - self._cpu_s) / len(items)
        for number, value in zip(items, values, strict=True):
            self._done[number] = self._encoded(value, run_s, cpu_s, len(items))

    def _encoded(self, value: Any, run_s: float, cpu_s: float, count: int) -> Outcome:
        try:
            frames = encode(value, self._kind.types, name="result").frames
        except Exception as error:  # noqa: BLE001 - a result may be anything
            return Outcome("failed", describe(error), run_s, cpu_s, server_fault=True, together=count)
        return Outcome("ok", "", run_s, cpu_s, frames=frames, together=count)

    def _failed(self, error: BaseException, items: dict[int, tuple[Any, ...]], *, in_task: bool) -> None:
        """Each is run alone afterwards, if it may run twice."""
        note = f"a run of {len(items)} requests failed, so each runs alone: {describe(error)}"
        if self._kind.duplicate and not isinstance(error, Unwanted):
            self._note = note
            return
        server_fault = not in_task or isinstance(error, Unwanted)
        run_s = time.perf_counter() - self._began_s
        for number in items:
            self._done[number] = Outcome(
                "failed", describe(error), run_s, server_fault=server_fault,
                traceback=traceback_in(error, server_fault=server_fault), together=len(items),
            )  # fmt: skip

    def _alone(self, call: Call) -> Outcome:
        waited_s = time.perf_counter() - self._began_s
        if waited_s >= call.budget_s:
            return Outcome("expired", queue_s=waited_s)
        outcome = run_task(call, self._states)
        outcome.queue_s = waited_s
        outcome.note, self._note = self._note, ""  # once
        return outcome


def _any_of(wanted: Sequence[Callable[[], bool]]) -> Callable[[], bool]:
    """Whether anybody wants one of the answers."""
    return lambda: any(one() for one in wanted)
