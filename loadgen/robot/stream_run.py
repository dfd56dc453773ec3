"""One run of a stream: sees and plays one step after the other, and records each.

Single calls are asked for in `run`.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from offboard.loadgen.progress import progress
from offboard.loadgen.rivals.stream_rules import RULES
from offboard.loadgen.robot.answers import Answered, Answers
from offboard.loadgen.robot.config import CallConfig, Streaming
from offboard.loadgen.robot.work import Work
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.streams.action_stream import ActionStream
from offboard.robot_client.streams.asking import Pace

SAID_S = 5.0  # between two lines of progress
DIGITS = 6  # of an action in the file of answers


def open_stream(
    offload: Offloader, function: Callable[..., Any], settings: Streaming, rule: str
) -> tuple[ActionStream, Pace]:
    """The stream that the settings ask for, which asks by this rule, and its pace."""
    assert settings.stream_hz is not None, "checked by the caller"
    pace = Pace(settings.stream_hz, settings.stream_horizon, settings.stream_calls_per_s)
    stream = offload.stream(
        function,
        hz=pace.hz,
        horizon=pace.horizon,
        calls_per_s=pace.calls_per_s,
        blend=settings.stream_blend,
    )
    stream.asking = RULES[rule](pace)
    return stream, pace


class StreamLoop:
    """The steps of one stream, and what the file of answers holds about each (docs/formats.md)."""

    def __init__(self, stream: ActionStream) -> None:
        self._stream = stream
        self._last: Any = None
        self._played = 0
        self.steps = self.empty = 0  # from the first chunk on
        self.age_s = 0.0

    def step(self, observation: Any) -> dict[str, Any]:
        stream = self._stream
        stream.see(observation)
        step = stream.next()
        played, seam = sum(stream.counts.played.values()), None
        if not step.held:
            if self._last is not None and played > self._played:
                seam = float(np.max(np.abs(step.action - self._last)))
            self._last, self._played = step.action, played
        begun = self._last is not None
        self.steps += begun
        self.empty += begun and step.held
        self.age_s += 0.0 if step.held or step.age_s is None else step.age_s
        action = None if step.action is None else np.round(step.action, DIGITS).ravel().tolist()
        return {
            **{"held": step.held, "age_s": step.age_s, "site": step.site, "quality": step.quality},
            **{"seam": seam, "action": action},
        }

    def __str__(self) -> str:
        fresh, counts = max(1, self.steps - self.empty), self._stream.counts
        asked = ", ".join(f"{site} {count}" for site, count in sorted(counts.asked.items()))
        return (
            f"{self.steps} steps from the first chunk on, {self.empty} of them without a fresh action "
            f"({100 * self.empty / max(1, self.steps):.2f} %); mean age {1e3 * self.age_s / fresh:.0f} ms; "
            f"chunks asked for: {asked or 'none'}"
        )


def run_stream(
    config: CallConfig, work: Work, offload: Offloader, *, say: Callable[[str], None], answers: Answers | None
) -> None:
    """Play `config.tasks_max` steps, each at its time; `work` gives the observations."""
    stream, pace = open_stream(offload, work.function, config, config.stream_rule)
    loop = StreamLoop(stream)
    try:
        with (
            stream,
            progress("steps", config.tasks_max, to=sys.stdout, every=int(SAID_S * pace.hz) + 1) as shown,
        ):
            if answers is not None:
                answers.begin()
            start_s = time.monotonic()
            for number in range(config.tasks_max):
                due_s = number * pace.step_s
                time.sleep(max(0.0, due_s - (time.monotonic() - start_s)))
                began_s = time.monotonic() - start_s
                (observation,) = work.request()
                said = loop.step(observation)
                work.advance(None)
                if answers is not None:
                    ended_s = time.monotonic() - start_s
                    answers.write(
                        Answered(
                            i=number,
                            id=None,
                            due_s=due_s,
                            began_s=began_s,
                            ended_s=ended_s,
                            error=None,
                            answer=said,
                        )
                    )
                shown.step()
    finally:
        say(str(loop))
