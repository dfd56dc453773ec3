"""The rules that call: once, in a batch, from asyncio, nested, with any value, and with tasks that fail."""

import asyncio
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import precondition, rule

from offboard import CloudError, DeadlineMissed, Offloader, TaskFailed
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.state import served
from tests.state.calls import Tally
from tests.state.run import Run, numbers, wheres
from tests.state.served import FAILURES, Point
from tests.state.server import Server

CELLS = 40_000  # of the map, which is then sent by its digest
NAP_S = 0.3  # longer than the timeout
ONCE = itertools.count()  # never the same: a server that was paused may run a call of an earlier robot late

waits = st.booleans()
# Some that can be sent, and some that cannot.
values = st.sampled_from(
    [None, 1.5, "text", b"x" * 70_000, {"a": [1, 2]}, Point(1.0, 2.0), 2**70, {1, 2}, "\ud800", {(1, 2): 3}]
)


def asking(rule: Callable[..., None]) -> Callable[..., None]:
    """A rule for a robot with an offloader."""
    return precondition(lambda self: self.offload is not None)(rule)


class CallRules(Run):
    """Each call is waited for, or left running."""

    def __init__(self, server: Server, folder: Path, tally: Tally) -> None:
        super().__init__(server, folder, tally)
        self.map = np.arange(CELLS)
        self.map.flags.writeable = False

    @asking
    @rule(number=numbers, where=wheres, wait=waits)
    def call(self, number: int, where: str | None, wait: bool) -> None:
        self.begin("call", lambda do: do(served.twice, number, where=where), 2 * number, wait=wait)

    @asking
    @rule(where=wheres, wait=waits)
    def call_slow_task(self, where: str | None, wait: bool) -> None:
        self.begin("slow call", lambda do: do(served.nap, NAP_S, where=where), NAP_S, wait=wait)

    @asking
    @rule(items=st.lists(numbers, max_size=8), where=wheres, wait=waits)
    def call_map(self, items: list[int], where: str | None, wait: bool) -> None:
        wanted = [2 * number for number in items]
        self.begin("map", lambda do: do.map(served.twice, items, where=where), wanted, wait=wait)

    @asking
    @rule(items=st.lists(numbers, min_size=1, max_size=4), where=wheres, wait=waits)
    def call_from_asyncio(self, items: list[int], where: str | None, wait: bool) -> None:
        async def gather(do: Offloader) -> list[int]:
            return await asyncio.gather(*(do.run(served.twice, number, where=where) for number in items))

        wanted = [2 * number for number in items]
        self.begin("async calls", lambda do: asyncio.run(gather(do)), wanted, wait=wait)

    @asking
    @rule(where=wheres, wait=waits)
    def cancel_async_call(self, where: str | None, wait: bool) -> None:
        async def cancel(do: Offloader) -> str:
            running = asyncio.ensure_future(do.run(served.nap, NAP_S, where=where))
            await asyncio.sleep(NAP_S / 10)
            running.cancel()
            try:
                return f"answered {await running}"
            except asyncio.CancelledError:
                return "cancelled"

        self.begin("cancelled async call", lambda do: asyncio.run(cancel(do)), "cancelled", wait=wait)

    @asking
    @rule(number=numbers, deadline_s=st.sampled_from([1e-3, 0.05, 2 * NAP_S]), where=wheres, wait=waits)
    def call_with_deadline(self, number: int, deadline_s: float, where: str | None, wait: bool) -> None:
        """It is answered or missed; what was expected before it is a number or unknown."""

        def act(do: Offloader) -> int:
            do.expect(served.twice, number, deadline_s=deadline_s)
            return do(served.twice, number, where=where, deadline_s=deadline_s)

        words = f"call with a deadline of {deadline_s:g} s"
        self.begin(words, act, 2 * number, wait=wait, allowed=lambda error: issubclass(error, DeadlineMissed))

    @asking
    @rule(number=numbers, where=wheres, wait=waits)
    def submit(self, number: int, where: str | None, wait: bool) -> None:
        def act(do: Offloader) -> int:
            return do.submit(served.twice, number, where=where).result()

        self.begin("submitted call", act, 2 * number, wait=wait)

    @asking
    @rule(number=numbers, depth=st.integers(1, 2), batch=st.booleans(), where=wheres, wait=waits)
    def call_nested(self, number: int, depth: int, batch: bool, where: str | None, wait: bool) -> None:
        def act(do: Offloader) -> int:
            return do(served.nested, number, depth, batch, where=where)

        self.begin("nested call", act, 2 * number + depth, wait=wait, nested=True)

    @asking
    @rule(number=numbers, depth=st.integers(0, 2), where=wheres, wait=waits)
    def call_with_setup(self, number: int, depth: int, where: str | None, wait: bool) -> None:
        def act(do: Offloader) -> int:
            return do(served.scaled, number, depth, where=where)

        words = f"call with a setup of depth {depth}"
        self.begin(words, act, 2 * number + depth, wait=wait, nested=True)

    @asking
    @rule(value=values, where=wheres, wait=waits)
    def call_with_any_value(self, value: Any, where: str | None, wait: bool) -> None:
        words = f"call with a value of {value!a:.40}"
        self.begin(words, lambda do: do(served.same, value, where=where), value, wait=wait)

    @asking
    @rule(how=st.sampled_from([*FAILURES]), where=wheres, wait=waits)
    def call_failing_task(self, how: str, where: str | None, wait: bool) -> None:
        name = FAILURES[how].__name__

        def failure(do: Offloader) -> str:
            try:
                return f"answered {do(served.fail, how, where=where)}"
            except TaskFailed as error:
                return name if name in str(error) else str(error)

        self.begin(f"failing call of the sort {how}", failure, name, wait=wait)

    @asking
    @rule(where=st.sampled_from([None, CLOUD, ONBOARD]), wait=waits)
    def call_once(self, where: str | None, wait: bool) -> None:
        """A task that must not run twice may end without an answer."""
        number, path = next(ONCE), str(self.once)

        def act(do: Offloader) -> int:
            return do(served.once, path, number, where=where)

        words = "call once of a task that must not run twice"
        self.begin(words, act, number, wait=wait, allowed=lambda error: issubclass(error, CloudError))

    @asking
    @rule(where=wheres, wait=waits)
    def call_with_map(self, where: str | None, wait: bool) -> None:
        grid, wanted = self.map, int(self.map.sum())
        self.begin("call with the map", lambda do: do(served.weigh, grid, where=where), wanted, wait=wait)

    @rule(cell=st.integers(0, CELLS - 1), copied=st.booleans())
    def change_map(self, cell: int, copied: bool) -> None:
        """Unlock, write and lock, as a mapper does, while no call may still send the map."""
        self.finish_all()
        if copied:
            self.map = self.map.copy()
        self.map.flags.writeable = True
        self.map[cell] += 1
        self.map.flags.writeable = False
        self.note("map changed")

    @precondition(lambda self: self.calls)
    @rule()
    def wait_for_oldest_call(self) -> None:
        self.finish(self.calls[0])
        self.note("oldest call awaited")
