"""The model of a network link: when bytes that arrive now come out at the other end.

Pure: time comes in as an argument, randomness from a seed. The sockets are in `relay.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.jitter import DELAY_MS_MAX as DELAY_MS_MAX
from offboard.loadgen.relay.link.jitter import DISTRIBUTIONS, SAMPLES, SAMPLES_MAX, Jitter, Samples, quantile
from offboard.loadgen.relay.link.loss import LOSS_BURST_MAX, Loss, stall_ms

SEGMENT_BYTES = 1448  # payload of one TCP segment on Ethernet: 1500 - 20 (IP) - 32 (TCP with timestamps)
CHUNK_BYTES = 8 * SEGMENT_BYTES  # the bucket at most: the first bytes of a long read do not wait for its last
BUCKET_S = 0.001  # and at most so long at the bandwidth, but never less than one segment
BANDWIDTH_MBPS_MAX = 100_000.0
RESET_MS_MAX = 86_400_000.0
TRUNCATE_BYTES_MAX = 1 << 50
NAMES = (*DISTRIBUTIONS, SAMPLES)

# Least and most of each condition that is a number.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "delay_ms": (0, DELAY_MS_MAX),
    "jitter_ms": (0, DELAY_MS_MAX),
    "bandwidth_mbps": (0, BANDWIDTH_MBPS_MAX),
    "correlation": (0, 1),
    "loss": (0, 1),
    "loss_burst": (1, LOSS_BURST_MAX),
    "stall_ms": (0, DELAY_MS_MAX),
    "reset_after_ms": (0, RESET_MS_MAX),
    "truncate_bytes": (0, TRUNCATE_BYTES_MAX),
    "slow_close_ms": (0, DELAY_MS_MAX),
}


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """One direction of a link. Bandwidth 0 is unlimited; reset or truncation 0 is never.

    In an outage nothing comes out until it ends, whatever was due: silence, not a reset. A side that hangs
    takes all that is said and answers nothing; what it took is lost, so its connections are reset when it
    wakes. `samples` are delays in ms, drawn as they are and added to `delay_ms` in place of the jitter.
    """

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    distribution: str = "normal"
    bandwidth_mbps: float = 0.0
    outage: bool = False
    correlation: float = 0.0
    samples: tuple[float, ...] = ()
    loss: float = 0.0
    loss_burst: float = 1.0
    stall_ms: float = 200.0
    hang: bool = False
    reset_after_ms: float = 0.0
    truncate_bytes: int = 0
    slow_close_ms: float = 0.0

    def __post_init__(self) -> None:
        for name, (least, most) in BOUNDS.items():
            _check_number(name, getattr(self, name), least, most)
        if type(self.truncate_bytes) is not int:
            raise ConfigError(f"truncate_bytes: {self.truncate_bytes!r} is not a whole number")
        for name in ("outage", "hang"):
            if not isinstance(getattr(self, name), bool):
                raise ConfigError(f"{name}: {getattr(self, name)!r} is neither true nor false")
        if not isinstance(self.samples, Samples):  # a list comes from JSON or TOML
            self._check_samples()
        if self.distribution not in NAMES:
            raise ConfigError(f"distribution: {self.distribution!r} is not one of {', '.join(NAMES)}")
        if self.distribution == SAMPLES and not self.samples:
            raise ConfigError("samples: none are given, distribution 'samples' draws from them")

    def _check_samples(self) -> None:
        if not isinstance(self.samples, list | tuple):
            raise ConfigError(f"samples: {self.samples!r} is not a list of delays in ms")
        if len(self.samples) > SAMPLES_MAX:
            raise ConfigError(f"samples: {len(self.samples)} are too many, at most {SAMPLES_MAX} are allowed")
        for value in self.samples:
            _check_number("samples", value, 0, DELAY_MS_MAX)
        object.__setattr__(self, "samples", Samples(sorted(self.samples)))

    def shown(self) -> dict[str, Any]:
        """For people and files: all by name, of the samples only how many."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"samples": len(self.samples)}


@dataclass(frozen=True, slots=True)
class Link:
    """Both directions: `up` is robot to cloud, `down` is cloud to robot."""

    up: LinkConditions = field(default_factory=LinkConditions)
    down: LinkConditions = field(default_factory=LinkConditions)

    def changed(self, changes: Mapping[str, Any]) -> "Link":
        """This link with some conditions changed: `up` and `down` hold those of one direction, any
        other name goes for both."""
        both = {name: value for name, value in changes.items() if name not in ("up", "down")}
        return Link(
            up=_changed("up", self.up, both | dict(changes.get("up") or {})),
            down=_changed("down", self.down, both | dict(changes.get("down") or {})),
        )


class Pipe:
    """One direction of one connection.

    arrived --> [ serialised at the bandwidth ] --> [ + delay + jitter + stall ] --> due, in order

    Jitter and loss are drawn once a segment of the byte stream, each effect from its own numbers, so a draw
    depends on seed, connection, direction and segment number alone: not on how the stream was cut into
    chunks, nor on the conditions before, nor on the other effects. Messages smaller than a segment can
    therefore share a draw; a lost segment stalls once, with all of it that came without a gap.
    Assigning `conditions` applies them to later chunks. The bandwidth is a token bucket of `bucket_bytes`,
    and nothing more is saved up while the link is idle.
    """

    def __init__(self, conditions: LinkConditions, seed: int, connection: int, direction: str) -> None:
        origin = f"{seed}/{connection}/{direction}"
        self._jitter = Jitter(origin)
        self._loss = Loss(origin)
        self._busy_until_s = -math.inf
        self._last_due_s = -math.inf
        self._segment_stall_ms = 0.0
        self.taken = 0  # bytes
        self.drawn_ms = 0.0  # delay and jitter of the segment that the last chunk ended in
        self.stall_ms = 0.0  # of the segments of the last chunk, at most
        self.conditions = conditions

    @property
    def conditions(self) -> LinkConditions:
        return self._conditions

    @conditions.setter
    def conditions(self, conditions: LinkConditions) -> None:
        self._conditions = conditions
        self._jitters = conditions.jitter_ms > 0 or conditions.distribution == SAMPLES
        self._draws = self._jitters or conditions.loss > 0
        self._s_a_byte = 8e-6 / conditions.bandwidth_mbps if conditions.bandwidth_mbps else 0.0
        self.bucket_bytes = SEGMENT_BYTES if self._draws else _bucket_bytes(self._s_a_byte)

    @property
    def segment(self) -> int:
        """Number of the segment that the next byte belongs to."""
        return self.taken // SEGMENT_BYTES

    def chunk_bytes(self, size: int) -> int:
        """How many of the next `size` bytes travel together: to the end of a segment, a bucket at most.

        One segment at a time where each draws its own delay, else a late one would hold those before it.
        All of them where neither a draw nor a bandwidth tells them apart.
        """
        if not self.bucket_bytes:
            return size
        return min(size, self.bucket_bytes - self.taken % SEGMENT_BYTES)

    def left(self, size: int) -> int:
        """How many of the next `size` bytes come before the stream is truncated."""
        most = self._conditions.truncate_bytes
        return min(size, max(0, most - self.taken)) if most else size

    def due(self, arrived_s: float, size: int) -> float:
        """When the last of the next `size` bytes comes out, unless an outage holds it longer."""
        if arrived_s > self._busy_until_s:  # what comes after a gap was not lost with the segment's beginning
            self._segment_stall_ms = 0.0
        sent_s = max(arrived_s, self._busy_until_s)
        self.stall_ms = 0.0
        if size == 0:
            return self._end_due(sent_s)
        due_s = self._last_due_s
        left = size
        while left:
            part = min(left, SEGMENT_BYTES - self.taken % SEGMENT_BYTES) if self._draws else left
            sent_s += part * self._s_a_byte
            due_s = max(due_s, sent_s + self._delay_s())
            self.taken += part
            left -= part
        self._busy_until_s, self._last_due_s = sent_s, due_s
        return due_s

    def _end_due(self, sent_s: float) -> float:
        """The end of the stream travels too, as late as its last segment; it is never lost."""
        self.drawn_ms = self._drawn_ms(max(0, self.taken - 1) // SEGMENT_BYTES)
        due_s = max(self._last_due_s, sent_s + self.drawn_ms / 1e3)
        return due_s + self._conditions.slow_close_ms / 1e3

    def _delay_s(self) -> float:
        """Of the part of a segment that is next."""
        self.drawn_ms = self._drawn_ms(self.segment)
        if self.taken % SEGMENT_BYTES == 0:
            now = self._conditions
            times = self._loss.times(self.segment, now.loss, now.loss_burst)
            self._segment_stall_ms = stall_ms(times, now.stall_ms)
        self.stall_ms = max(self.stall_ms, self._segment_stall_ms)
        return (self.drawn_ms + self._segment_stall_ms) / 1e3

    def _drawn_ms(self, segment: int) -> float:
        now = self._conditions
        if not self._jitters:
            return now.delay_ms
        draw = self._jitter.at(segment, now.correlation)
        if now.distribution == SAMPLES:
            return now.delay_ms + quantile(now.samples, draw)
        return max(0.0, now.delay_ms + now.jitter_ms * DISTRIBUTIONS[now.distribution](draw))


def _bucket_bytes(s_a_byte: float) -> int:
    """Whole segments; 0 is unlimited."""
    if not s_a_byte:
        return 0
    segments = int(BUCKET_S / (s_a_byte * SEGMENT_BYTES))
    return max(1, min(CHUNK_BYTES // SEGMENT_BYTES, segments)) * SEGMENT_BYTES


def _changed(direction: str, conditions: LinkConditions, changes: Mapping[str, Any]) -> LinkConditions:
    known = [f.name for f in fields(LinkConditions)]
    for name in changes:
        if name not in known:
            raise ConfigError(f"{name}: unknown condition; known: {', '.join(known)}, up, down")
    try:
        return replace(conditions, **changes)
    except ConfigError as error:
        raise ConfigError(f"{direction}.{error}") from None


def _check_number(name: str, value: object, least: float, most: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and least <= value <= most):  # type: ignore[operator]
        raise ConfigError(f"{name}: {value!r} is not a number from {least:g} to {most:g}")
