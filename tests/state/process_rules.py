"""The rules of the robot's own process: it opens, closes and drops offloaders, and forks."""

import asyncio
import gc
import time
import warnings
from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule

from offboard import Offloader, OffloadError
from offboard.common.errors import describe
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.state import served
from tests.state.calls import HUNG, HUNG_S, LOST, WRONG, Call
from tests.state.forked import said_by_child
from tests.state.leftovers import SETTLE_S
from tests.state.run import TIMEOUT_S, Run, numbers

POLICIES = ("default", CLOUD, ONBOARD, "paper", "paper-with-heartbeats", "greedy")


def is_offload_error(error: type) -> bool:
    return issubclass(error, OffloadError)


class ProcessRules(Run):
    """A forked child uses what it inherited, or an offloader of its own."""

    @initialize(policy=st.sampled_from(POLICIES), memory=st.booleans())
    def first_offloader(self, policy: str, memory: bool) -> None:
        self.open(policy, memory=memory)

    @precondition(lambda self: self.offload is None)
    @rule(policy=st.sampled_from(POLICIES), memory=st.booleans())
    def open_offloader(self, policy: str, memory: bool) -> None:
        self.open(policy, memory=memory)
        self.note("offloader opened")

    @precondition(lambda self: self.offload is not None)
    @rule()
    def close_offloader(self) -> None:
        """A call after the close is refused at once."""
        self.note("offloader closed")
        closed = self.close()
        words = "call after the close"
        self.judge(Call(words, lambda: closed(served.twice, 1), None, allowed=is_offload_error))

    @precondition(lambda self: self.offload is not None)
    @rule()
    def drop_offloader(self) -> None:
        """The last reference goes, and nobody closed it: there is a warning, and nothing is left over."""
        self.finish_all()
        self.note("offloader dropped")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            served.robot.clear()
            self.offload = None
            end_s = time.monotonic() + SETTLE_S  # a run that lost its race may still refer to it
            while not (warned := any("offloader was dropped" in str(one.message) for one in said)):
                if time.monotonic() > end_s:
                    break
                gc.collect()
                time.sleep(0.01)
        if not warned:
            self.fail(LOST, "no ResourceWarning for an offloader that was dropped without close")

    @precondition(lambda self: self.offload is not None)
    @rule(act=st.sampled_from(["call", "map", "run", "wait"]))
    def fork_and_call(self, act: str) -> None:
        """A forked child gets one clear error."""
        do = self.open_offload
        acts: dict[str, Callable[[], Any]] = {
            "call": lambda: do(served.twice, 1),
            "map": lambda: do.map(served.twice, [1, 2]),
            "run": lambda: asyncio.run(do.run(served.twice, 1)),
            "wait": lambda: do.wait_for_sites(served.twice, 1.0),
        }
        said = self.said_by_child(f"{act} in a forked child", acts[act])
        if not (said.startswith("OffloadError:") and "fork" in said):
            self.fail(LOST, f"{act} in a forked child: {said} instead of an OffloadError about the fork")

    @precondition(lambda self: self.offload is not None)
    @rule()
    def fork_and_close(self) -> None:
        """A forked child may close what it inherited; the parent goes on."""
        self.expect_of_child("close in a forked child", self.open_offload.close, None)

    @rule(number=numbers)
    def fork_and_connect(self, number: int) -> None:
        """An offloader that a forked child opens works."""

        def act() -> int:
            served.robot.clear()
            with Offloader.connect(self.server.endpoint, timeout_s=TIMEOUT_S) as do:
                return do(served.twice, number)

        self.expect_of_child("new offloader in a forked child", act, 2 * number)

    def expect_of_child(self, words: str, act: Callable[[], Any], wanted: Any) -> None:
        said = self.said_by_child(words, act)
        if said != repr(wanted):
            self.fail(WRONG, f"{words}: {said} instead of {wanted!r}")

    def said_by_child(self, words: str, act: Callable[[], Any]) -> str:
        self.note(words)
        self.tally.calls += 1
        try:
            return said_by_child(act, HUNG_S)
        except TimeoutError as error:
            self.fail(HUNG, f"{words}: {describe(error)}")
            raise
