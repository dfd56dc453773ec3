"""A recorded link: what was measured over time, and what that does to the bytes of one direction.

Pure. `recording_file.py` reads it from a file; `pipe.py` puts it together with the other conditions.
"""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, pairwise
from typing import Any

from offboard.common.errors import ConfigError

RTT, MBPS, UP_MBPS, DOWN_MBPS = "rtt_ms", "mbps", "up_mbps", "down_mbps"
RATES = {"up": (UP_MBPS, MBPS), "down": (DOWN_MBPS, MBPS)}  # the columns that hold the rate of a direction
BYTES_PER_MBIT = 125_000
NEVER_S = 1e9  # a finite time, so that it can be written as JSON
ROUNDING_BYTES = 1e-3  # so that a rounding error does not hold a message until a silence is over


@dataclass(frozen=True, slots=True)
class Recording:
    """Rows in order of time: row n holds from `times[n]` to `times[n + 1]`, where the last time is the end.

    `columns` has one value for each row.
    """

    file: str
    sha256: str
    times: Sequence[float] = field(compare=False, repr=False)
    columns: Mapping[str, Sequence[float]] = field(compare=False, repr=False)

    @property
    def length_s(self) -> float:
        return self.times[-1]


@dataclass(frozen=True, slots=True)
class Rate:
    """Bytes through time: `bytes_per_s` of each row, and `passed`, the bytes that pass before each time."""

    bytes_per_s: Sequence[float]
    passed: Sequence[float]


@dataclass(frozen=True, slots=True)
class Playback:
    """A recording in one direction of a link. It is at `from_s` until `begun_s`, and moves on from then.

    At its end it `repeats`, or its last row holds for ever.

        delay   half the round trip, at the time when a message enters
        rate    a message takes as long as the recorded rates need for its bytes
    """

    recording: Recording
    direction: str
    from_s: float = 0.0
    repeats: bool = True
    begun_s: float = math.inf
    rate: Rate | None = field(init=False, compare=False, repr=False, default=None)

    def __post_init__(self) -> None:
        length_s = self.recording.length_s
        if not 0 <= self.from_s < length_s:
            raise ConfigError(
                f"recording_from_s: {self.from_s:g} is not from 0 to below {length_s:g},"
                f" the seconds of {self.recording.file}"
            )
        for column in RATES[self.direction]:
            if column in self.recording.columns:
                object.__setattr__(self, "rate", _rate(self.recording, column))
                return

    @property
    def delays(self) -> bool:
        """Whether it has the delay of this direction."""
        return RTT in self.recording.columns

    def replaced(self) -> tuple[str, ...]:
        """The conditions of the link that are recorded."""
        delay = ("delay_ms",) if self.delays else ()
        return delay if self.rate is None else (*delay, "bandwidth_mbps")

    def shown(self) -> dict[str, Any]:
        """What is played, for people and files."""
        recorded = self.recording
        about = {"file": recorded.file, "sha256": recorded.sha256, "columns": list(recorded.columns)}
        return about | {"from_s": self.from_s, "repeats": self.repeats}

    def delay_ms(self, enters_s: float) -> float:
        """The delay of a message that enters now; 0 if it is not recorded."""
        if not self.delays:
            return 0.0
        return self.recording.columns[RTT][self._row(self._lap(self._at_s(enters_s))[1])] / 2

    def sent_s(self, begins_s: float, size: int) -> float:
        """When the last of `size` bytes is sent, if the first one begins now; NEVER_S later if never."""
        if self.rate is None or not size:
            return begins_s
        if begins_s < self.begun_s:
            return begins_s + size / self._waiting_rate(self.rate)
        at_s = self._at_s(begins_s)
        count = self._passed(self.rate, at_s) + size - ROUNDING_BYTES
        return begins_s + max(0.0, self._reaches_s(self.rate, count) - at_s)

    def _at_s(self, now_s: float) -> float:
        """The place in the recording, counted on over its repeats."""
        return self.from_s + max(0.0, now_s - self.begun_s)

    def _lap(self, at_s: float) -> tuple[float, float]:
        """How often the recording has ended by then, and the place in the present round."""
        length_s = self.recording.length_s
        return divmod(at_s, length_s) if self.repeats else (0.0, min(at_s, length_s))

    def _row(self, at_s: float) -> int:
        times = self.recording.times
        return min(bisect_right(times, at_s), len(times) - 1) - 1

    def _waiting_rate(self, rate: Rate) -> float:
        """Before the recording begins: the first rate above 0, so that robots can connect."""
        row = self._row(self.from_s)
        return next(value for value in chain(rate.bytes_per_s[row:], rate.bytes_per_s) if value)

    def _passed(self, rate: Rate, at_s: float) -> float:
        """The bytes that pass from the start of the recording until then."""
        laps, within_s = self._lap(at_s)
        row = self._row(within_s)
        passed = rate.passed[row] + (within_s - self.recording.times[row]) * rate.bytes_per_s[row]
        after_s = 0.0 if self.repeats else max(0.0, at_s - self.recording.length_s)
        return laps * rate.passed[-1] + passed + after_s * rate.bytes_per_s[-1]

    def _reaches_s(self, rate: Rate, count: float) -> float:
        """The place where this many bytes have passed."""
        times, whole = self.recording.times, rate.passed[-1]
        if not self.repeats and count > whole:
            last = rate.bytes_per_s[-1]
            return times[-1] + ((count - whole) / last if last else NEVER_S)
        laps, left = divmod(count, whole)
        if not left:  # the end of a round, and not the start of the next one
            laps, left = laps - 1, whole
        row = bisect_left(rate.passed, left) - 1  # a row with a rate above 0
        return laps * times[-1] + times[row] + (left - rate.passed[row]) / rate.bytes_per_s[row]


def _rate(recording: Recording, column: str) -> Rate:
    bytes_per_s = array("d", (BYTES_PER_MBIT * value for value in recording.columns[column]))
    durations = (end - start for start, end in pairwise(recording.times))
    sent = (seconds * rate for seconds, rate in zip(durations, bytes_per_s, strict=True))
    return Rate(bytes_per_s, array("d", accumulate(sent, initial=0.0)))
