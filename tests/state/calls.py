"""Calls of the state machine: each runs in a thread of its own, and is judged by its answer and its time."""

import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any

from offboard.common.errors import OffloadError, TaskError, describe

# More than all calls that run at once need one after the other, with a timeout for each.
HUNG_S = 20.0
FRAMES_SHOWN = 12
LOST, WRONG, HUNG = "lost", "wrong", "hung"


class Tally:
    """What was done, and what went wrong, in all runs of the state machine."""

    def __init__(self) -> None:
        self.steps: Counter[str] = Counter()
        self.bad: Counter[str] = Counter({LOST: 0, WRONG: 0, HUNG: 0})
        self.calls = self.runs = 0
        self.longest_s = 0.0

    def count(self, how: str) -> None:
        """Something went wrong. After the first time, the same steps are repeated in search of fewer."""
        self.bad[how] += 1
        if self.bad.total() == 1:
            print(self)

    def __str__(self) -> str:
        bad = ", ".join(f"{count} {how}" for how, count in self.bad.items())
        steps = "".join(f"\n{count:6} {name}" for name, count in self.steps.most_common())
        return (
            f"{self.runs} runs, {self.steps.total()} steps, {self.calls} calls: {bad}; "
            f"the longest call took {self.longest_s:.2f} s{steps}"
        )


def never(_: type) -> bool:
    return False


class Call:
    """One call, which has begun.

    `words`: what is asked, for the report. `wanted`: the right answer.
    `allowed`: whether it may end with an error of this type instead.
    `nested`: its task calls too, so an error of an inner call may be that of its task.
    `closing`: its offloader is being closed, so it may end with an error that says so.
    """

    def __init__(
        self,
        words: str,
        act: Callable[[], Any],
        wanted: Any,
        *,
        allowed: Callable[[type], bool] = never,
        nested: bool = False,
    ) -> None:
        self.closing = False
        self._words = words
        self._wanted = wanted
        self._allowed = allowed
        self._nested = nested
        self._answer: Any = None
        self._error: tuple[type, str] | None = None  # the exception itself would keep the offloader alive
        self._began_s, self._ended_s = time.monotonic(), 0.0
        self._thread = threading.Thread(target=self._run, args=(act,), name="call", daemon=True)
        self._thread.start()

    def judge(self) -> tuple[str, str] | None:
        """Wait until it ends. None if all is well; otherwise what is wrong, in one word and in many."""
        self._thread.join(max(0.0, self._began_s + HUNG_S - time.monotonic()))
        if self._thread.is_alive():
            return HUNG, f"{self._words}: no answer after {HUNG_S:g} s; it is here:\n{self._stack()}"
        if self.seconds > HUNG_S:
            return HUNG, f"{self._words}: it took {self.seconds:.1f} s"
        if self._error is not None:
            kind, text = self._error
            return None if self._may_fail(kind) else (LOST, f"{self._words}: {text}")
        if self._answer != self._wanted or type(self._answer) is not type(self._wanted):
            return WRONG, f"{self._words}: {self._answer!r} instead of {self._wanted!r}"
        return None

    @property
    def seconds(self) -> float:
        return (self._ended_s or time.monotonic()) - self._began_s

    def _run(self, act: Callable[[], Any]) -> None:
        try:
            self._answer = act()
        except BaseException as error:  # noqa: BLE001 - any of them must be judged
            self._error = type(error), describe(error)
        self._ended_s = time.monotonic()

    def _may_fail(self, kind: type) -> bool:
        by_close = issubclass(kind, OffloadError) and (self._nested or not issubclass(kind, TaskError))
        return self._allowed(kind) or (self.closing and by_close)

    def _stack(self) -> str:
        frame = sys._current_frames().get(self._thread.ident or 0)
        return "".join(traceback.format_stack(frame)[-FRAMES_SHOWN:]) if frame else "(it has just ended)"
