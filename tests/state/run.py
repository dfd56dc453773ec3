"""One run of the state machine, without its rules: begins calls, judges them, and finds what is left over."""

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine

from offboard import Offloader, Settings
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.state import served
from tests.state.calls import HUNG, LOST, WRONG, Call, Tally, never
from tests.state.leftovers import Leftovers
from tests.state.server import Server

TIMEOUT_S = 0.2  # of a server: long for the tasks, and short for a run with many silent servers
RUNNING_MAX = 6  # calls at the same time
FILES = ("once.txt", "trace.jsonl", "memory.json")

numbers = st.integers(0, 99)
wheres = st.sampled_from([None, None, CLOUD, ONBOARD, "both"])


class Run(RuleBasedStateMachine):
    """A robot whose server runs at the start. It must leave nothing behind at the end.

    `offload` is None while the robot has none. `calls` are those that may still run.
    """

    def __init__(self, server: Server, folder: Path, tally: Tally) -> None:
        super().__init__()
        self.server, self.tally = server, tally
        self.offload: Offloader | None = None
        self.calls: list[Call] = []
        self.once, self.trace, self.memory = (folder / name for name in FILES)
        for file in (self.once, self.trace, self.memory):
            file.unlink(missing_ok=True)
        self._bad = False
        self._before = Leftovers()
        tally.runs += 1

    @property
    def open_offload(self) -> Offloader:
        assert self.offload is not None
        return self.offload

    def open(self, policy: str, *, memory: bool) -> None:
        self.offload = Offloader.connect(
            self.server.endpoint,
            policy=policy,
            timeout_s=TIMEOUT_S,
            trace=self.trace,
            settings=Settings(memory=self.memory if memory else None),
        )
        served.robot[:] = [self.offload]

    def close(self) -> Offloader:
        """Close the offloader, and return it; calls that run may end without an answer."""
        closed, self.offload = self.open_offload, None
        for one in self.calls:
            one.closing = True
        self.judge(Call("close", closed.close, None))
        self.finish_all()
        served.robot.clear()
        return closed

    def begin(
        self,
        words: str,
        act: Callable[[Offloader], Any],
        wanted: Any,
        *,
        wait: bool,
        allowed: Callable[[type], bool] = never,
        nested: bool = False,
    ) -> None:
        """Begin a call, and wait for it, or else for the oldest one if too many run."""
        do = self.open_offload
        self.note(words.partition(" of ")[0])
        text = f"{words}, while the server is {self.server.state}"
        call = Call(text, lambda: act(do), wanted, allowed=allowed, nested=nested)
        self.calls.append(call)
        if wait:
            self.finish(call)
        elif len(self.calls) > RUNNING_MAX:
            self.finish(self.calls[0])

    def finish(self, call: Call) -> None:
        self.calls.remove(call)
        self.judge(call)

    def finish_all(self) -> None:
        while self.calls:
            self.finish(self.calls[0])

    def judge(self, call: Call) -> None:
        verdict = call.judge()
        self.tally.calls += 1
        self.tally.longest_s = max(self.tally.longest_s, call.seconds)
        if verdict is not None:
            self.fail(*verdict)

    def note(self, step: str) -> None:
        self.tally.steps[step] += 1

    def fail(self, how: str, why: str) -> None:
        """Count it and end the run. What goes wrong after it in this run is not counted."""
        if not self._bad:
            self._bad = True
            self.tally.count(how)
            raise AssertionError(f"{how}: {why}")

    def teardown(self) -> None:
        try:
            self.finish_all()
            if self.offload is not None:
                self.close()
            if not self._bad:
                self._check_end()
        finally:
            served.robot.clear()
            self.server.heal()

    def _check_end(self) -> None:
        if self.once.exists() and (again := _repeated(self.once.read_text().split())):
            self.fail(WRONG, f"tasks that must run once ran again: {again}")
        records = read_trace(self.trace) if self.trace.exists() else ()
        if again := _repeated(record["id"] for record in records):
            self.fail(WRONG, f"tasks that are in the trace twice: {again}")
        if self.memory.with_name(f"{self.memory.name}.unreadable").exists():
            self.fail(WRONG, "the memory file could not be read")
        if (how := self.server.ended()) is not None:
            self.fail(LOST, how)
        if left := self._before.found():
            self.fail(HUNG, f"left over: {', '.join(left)}")


def _repeated(names: Iterable[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]
