"""A stream of actions: the robot says what it sees, and takes the action of each step.

One thread looks at the queue once in each step, and asks; answers come in the threads of their calls. When to
ask whom is decided in `asking`, and what becomes of an answer in `action_queue`.
"""

import logging
import math
import os
import threading
import warnings
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from offboard.common.errors import BadValue, CloudTimeout, ConfigError, OffloadError, describe, is_interrupt
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.records.record import ChunkRecord
from offboard.robot_client.sites.runner import ONBOARD, Execution
from offboard.robot_client.sites.waiting import Clock
from offboard.robot_client.streams.action_queue import ActionQueue, Actions, Chunk, Placed
from offboard.robot_client.streams.asking import BLEND, HORIZON_MAX, Asking, Pace
from offboard.robot_client.streams.counts import Counts

JOIN_S = 5.0  # for which `close` waits for the thread, which may be in the user's `ask`
SLOW = 0.9  # a loop with a smaller share of `hz` gets a warning
WARNED_S = 10.0  # between two warnings about empty queues
LOOK_S = 1.0  # for which the steps of a loop are counted

OnEmpty = Literal["last", "zeros"] | Callable[[], Any]
Ask = Callable[[Any, int, Actions], Any]

log = logging.getLogger(__name__)


class Step(NamedTuple):
    """The action of one step.

    action: of shape (dimensions,). None: no chunk has come yet, and `on_empty` is no function.
    age_s: since the observation that it comes from was seen. site: that has computed it. quality: of its
    variant, from 0 to 1. None for each of them: there is no such observation.
    held: the queue was empty, and the action is that of `on_empty`.
    """

    action: Actions | None
    age_s: float | None = None
    site: str | None = None
    quality: float | None = None
    held: bool = False


class Seen(NamedTuple):
    """One observation; `number` counts them, `step` is the one for which it was seen."""

    number: int
    observation: Any
    step: int
    at_s: float


@dataclass(slots=True)
class Question:
    """One question to a site, and when it was asked. taken: its answer, or its failure, has come."""

    site: str
    seen: Seen
    step: int
    at_s: float
    episode: int
    taken: bool = False


class Caller(Protocol):
    """What a stream asks of its offloader."""

    clock: Clock
    steps_itself: bool  # whether it calls `look` of its streams

    def able(self) -> Mapping[str, float]:
        """The sites that can be asked now, and what the quality that each one loses is worth in seconds."""

    def call(
        self,
        item: Any,
        site: str,
        timeout_s: float,
        take: Callable[[Execution], ChunkRecord | None],
        *,
        useful_s: float | None = None,
    ) -> CallFuture[Any]:
        """Begin one call on this site, and on no other one. `take` gets its answer."""

    def quality(self, site: str) -> float: ...

    def refuse(self) -> None:
        """OffloadError if the offloader is closed, or belongs to another process."""


class ActionStream:
    """Plays the actions of a policy, and asks for the next ones in time. Made by `Offloader.stream`.

    `see` may be called by any thread, `next` by one. Neither of them blocks.
    `asking`: when it asks whom. A bench puts another rule there before the first observation.
    """

    def __init__(
        self,
        name: str,
        caller: Caller,
        pace: Pace,
        *,
        actions: Callable[[Any], Any] | None = None,
        ask: Ask | None = None,
        blend: int = BLEND,
        on_empty: OnEmpty = "last",
    ) -> None:
        if isinstance(blend, bool) or not isinstance(blend, int) or not 0 <= blend <= HORIZON_MAX:
            raise ConfigError(f"blend {blend!r}: must be a whole number from 0 to {HORIZON_MAX}")
        if on_empty not in ("last", "zeros") and not callable(on_empty):
            raise ConfigError(f"on_empty {on_empty!r}: must be 'last', 'zeros' or a function")
        self._name, self._caller, self._pace = name, caller, pace
        self._read, self._ask, self._on_empty = actions, ask, on_empty
        self._now_s = caller.clock.now_s
        self.counts = Counts()
        self._queue = ActionQueue(blend)
        self.asking = Asking(pace)
        self._lock = threading.Lock()  # for everything that an answer or the thread changes
        self._step = self._numbers = self._episode = 0
        self._seen: Seen | None = None
        self._last: Actions | None = None
        self._under_way: set[CallFuture[Any]] = set()
        self._error: BaseException | None = None  # the last of onboard, until there is an action again
        self._broken: Exception | None = None  # what has ended the thread
        self._held = self._slow = False
        self._warn_at_s = -math.inf
        self._said: set[str] = set()  # sites of whose failure the log has heard
        self._looked = (self._now_s(), 0)
        self._stop, self._process = threading.Event(), os.getpid()
        self._thread = self._started()

    def _started(self) -> threading.Thread | None:
        """The thread that looks at the queue; None if the caller calls `look` in its own time."""
        if self._caller.steps_itself:
            return None
        args = weakref.ref(self), self._stop, self._pace.step_s
        thread = threading.Thread(target=_keep, args=args, name="stream", daemon=True)
        thread.start()
        return thread

    def see(self, observation: Any) -> None:
        """This is the newest observation. It must not be changed afterwards."""
        self._numbers += 1
        self._seen = Seen(self._numbers, observation, self._step, self._now_s())

    def next(self) -> Step:
        """The action of the next step.

        OffloadError: the stream or its offloader is closed. If the queue is empty, and nothing but onboard is
        left, this raises what the onboard policy raised.
        """
        if self._stop.is_set():
            raise OffloadError("the stream is closed")
        self._caller.refuse()
        step, chunk, counts = self._step, self._queue.playing, self.counts
        self._step = step + 1
        counts.steps += 1
        if chunk is None or step >= chunk.end:
            counts.empty += 1
            return self._stand_in(chunk)
        self._held = False
        action = self._last = chunk.actions[step - chunk.first]
        age_s = self._now_s() - chunk.seen_s
        counts.age_s += age_s
        return Step._make((action, age_s, chunk.site, chunk.quality, False))

    def reset(self) -> None:
        """Begin an episode: nothing of the old one is played, and what is under way is cancelled."""
        with self._lock:
            self._episode += 1
            self._queue.clear()
            self.asking.begin()
            self._seen = self._last = self._error = None
            under_way = list(self._under_way)
            self._under_way.clear()
        for future in under_way:
            future.cancel()

    def late_s(self) -> dict[str, float]:
        """The forecast for each site: in how many seconds its next chunk should be here."""
        with self._lock:
            return self.asking.forecasts()

    def close(self) -> None:
        """Stop, and cancel what is under way. Safe to call twice."""
        self._stop.set()
        if os.getpid() != self._process:  # a forked process: the calls are those of the other one
            return
        if self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join(JOIN_S)
        with self._lock:
            under_way = list(self._under_way)
        for future in under_way:
            future.cancel()

    def __enter__(self) -> "ActionStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stand_in(self, chunk: Chunk | None) -> Step:
        """The step of an empty queue."""
        if self._broken is not None:
            raise self._broken
        if self._error is not None and not self.asking.waits_for_server():
            raise self._error
        if chunk is not None and not self._held and self._now_s() >= self._warn_at_s:
            self._warn_at_s = self._now_s() + WARNED_S
            log.warning(
                "stream %s: no action is left at step %d, as no chunk has come in time; remedy: a longer "
                "horizon, a larger calls_per_s, or a faster policy onboard",
                *(self._name, self._step - 1),
            )
        self._held = True
        if callable(self._on_empty):
            action = np.asarray(self._on_empty())
        elif self._last is None or chunk is None:
            action = None
        elif self._on_empty == "last":
            age_s = self._now_s() - chunk.seen_s
            return Step(self._last, age_s, site=chunk.site, quality=chunk.quality, held=True)
        else:
            action = np.zeros_like(self._last)
        return Step(action, held=True)

    def look(self) -> None:
        """Ask whom it is time to ask. Called by the thread, once in each step."""
        now_s = self._now_s()
        self._look_at_loop(now_s)
        able = self._caller.able()
        with self._lock:
            seen, step = self._seen, self._step
            if seen is None:
                return
            left_s = self._queue.left(step) * self._pace.step_s
            sites = self.asking.due(now_s, left_s, able, seen=seen.number)
            for site in sites:
                self.asking.asked(site, now_s, seen=seen.number)
                self.counts.asked[site] += 1
            questions = [Question(site, seen, step, at_s=now_s, episode=self._episode) for site in sites]
        for question in questions:
            self._send(question, self.asking.useful_s(question.site, left_s, able))

    def _send(self, question: Question, useful_s: float) -> None:
        take = partial(self._take, question)
        try:
            future = self._caller.call(
                self._item(question), question.site, self.asking.patience_s, take, useful_s=useful_s
            )
        except BaseException as error:  # `ask` is the user's own
            with self._lock:
                self.asking.failed(question.site, self._now_s())
                self._error = error
            if is_interrupt(error):
                raise
            return
        with self._lock:
            self._under_way.add(future)
        future.add_done_callback(partial(self._end, question))

    def _item(self, question: Question) -> Any:
        observation = question.seen.observation
        if self._ask is None:
            return observation
        mean_s = self.asking.mean_s(question.site)
        delay = 0 if mean_s is None else math.ceil(mean_s / self._pace.step_s)
        return self._ask(observation, delay, self._queue.upcoming(question.step, delay))

    def _take(self, question: Question, answer: Execution) -> ChunkRecord | None:
        """Play the answer of a call, or note its failure; what became of it, for the record."""
        with self._lock:
            if question.episode != self._episode or self._stop.is_set():
                return None
            question.taken = True
            now_s, step, site = self._now_s(), self._step, question.site
            expected_s, left, count, placed = self.asking.late_s(site), self._queue.left(step), 0, None
            try:
                if answer.failure is not None:
                    raise answer.failure
                actions = self._queue.checked(answer.value, self._read)
            except CloudTimeout:
                outcome = "lost"
                self.asking.lost(site)
            except BaseException as error:  # noqa: BLE001 - of the policy; `next` raises it
                outcome = "refused" if isinstance(error, BadValue) else "failed"
                self._fail(site, error)
            else:
                count, placed = len(actions), self._place(question, answer.site, actions, now_s)
                outcome = "late" if placed is None else "played"
            getattr(self.counts, outcome)[answer.site] += 1
            return ChunkRecord(
                outcome,
                self._pace.hz,
                question.seen.step,
                question.step,
                expected_s=expected_s,
                arrived_s=now_s - question.at_s,
                left=left,
                actions=count,
                dropped=None if placed is None else placed.dropped,
                seam=None if placed is None else placed.seam,
            )

    def _place(self, question: Question, used: str, actions: Actions, now_s: float) -> Placed | None:
        """Play the actions from now on, unless they are too old."""
        seen, site = question.seen, question.site
        if used == site:
            self.asking.arrived(site, now_s)
            self._said.discard(site)
        else:  # the site could not take it any more, so that it ran onboard
            self.asking.failed(site, now_s)
        quality = self._caller.quality(used)
        chunk = Chunk(actions, first=seen.step, seen_s=seen.at_s, site=used, quality=quality)
        placed = self._queue.put(chunk, self._step)
        if placed is not None:
            self._error = None
        return placed

    def _end(self, question: Question, future: CallFuture[Any]) -> None:
        """A call has ended; if nobody has taken its answer, it has none."""
        with self._lock:
            self._under_way.discard(future)
            if question.taken or question.episode != self._episode or self._stop.is_set():
                return
            error = None if future.cancelled() else future.exception()
            if error is None:  # the offloader has withdrawn it
                self.asking.failed(question.site, self._now_s())
            else:
                self.counts.failed[question.site] += 1
                self._fail(question.site, error)

    def _fail(self, site: str, error: BaseException) -> None:
        self.asking.failed(site, self._now_s())
        if site == ONBOARD:
            self._error = error
        if site not in self._said:
            self._said.add(site)
            what = str(error) if isinstance(error, OffloadError) else describe(error)
            log.warning(
                "stream %s: no chunk of %s: %s; it is asked again later; remedy: robot-client check",
                *(self._name, site, what),
            )

    def _look_at_loop(self, now_s: float) -> None:
        """Say once if the loop is slower than it said."""
        since_s, steps = self._looked
        if now_s - since_s < LOOK_S:
            return
        made, wanted = self._step - steps, SLOW * self._pace.hz * (now_s - since_s)
        if steps > 0 and made < wanted and not self._slow:
            self._slow = True
            log.warning(
                "stream %s: next() was called %d times in %.1f s, but hz=%g; remedy: give the true rate",
                *(self._name, made, now_s - since_s, self._pace.hz),
            )
        self._looked = now_s, self._step


def _keep(stream: "weakref.ref[ActionStream]", stop: threading.Event, step_s: float) -> None:
    """Look at the queue once in each step, until the stream is closed or dropped."""
    while not stop.wait(step_s):
        found = stream()
        if found is None:
            warnings.warn("a stream was dropped without close()", ResourceWarning, stacklevel=1)
            return
        try:
            found.look()
        except OffloadError:
            return  # the offloader is closed
        except Exception as error:  # noqa: BLE001 - of a runner of the user's own
            found._broken = error
            return
        del found
