"""The model of a network link: when bytes that arrive now come out at the other end.

Pure: time comes in as an argument, randomness from a seed. The sockets are in `relay.py`.
"""

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from statistics import NormalDist
from typing import Any

from common.errors import ConfigError

SEGMENT_BYTES = 1448  # payload of one TCP segment on Ethernet: 1500 - 20 (IP) - 32 (TCP with timestamps)
DELAY_MS_MAX = 60_000.0
BANDWIDTH_MBPS_MAX = 100_000.0

PARETO_SHAPE = 3.0
PARETO_SD = math.sqrt(PARETO_SHAPE / (PARETO_SHAPE - 2)) / (PARETO_SHAPE - 1)
LOGNORMAL_SD = math.sqrt((math.e - 1) * math.e)
_NORMAL = NormalDist()

# Each maps one uniform draw in (0, 1) to a deviation; times jitter_ms it is what the delay grows by.
# Standard deviation 1, but for constant (always late by jitter_ms) and uniform (half width 1, as netem).
# Pareto and log-normal have the long tail of queues and radio links: never early, sometimes very late.
DISTRIBUTIONS: dict[str, Callable[[float], float]] = {
    "constant": lambda _: 1.0,
    "uniform": lambda u: 2 * u - 1,
    "normal": _NORMAL.inv_cdf,
    "pareto": lambda u: ((1 - u) ** (-1 / PARETO_SHAPE) - 1) / PARETO_SD,
    "lognormal": lambda u: math.exp(_NORMAL.inv_cdf(u)) / LOGNORMAL_SD,
}


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """One direction of a link. Bandwidth 0 is unlimited.

    In an outage nothing comes out until it ends, whatever was due: silence, not a reset.
    """

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    distribution: str = "normal"
    bandwidth_mbps: float = 0.0
    outage: bool = False

    def __post_init__(self) -> None:
        _check_number("delay_ms", self.delay_ms, DELAY_MS_MAX)
        _check_number("jitter_ms", self.jitter_ms, DELAY_MS_MAX)
        _check_number("bandwidth_mbps", self.bandwidth_mbps, BANDWIDTH_MBPS_MAX)
        if self.distribution not in DISTRIBUTIONS:
            raise ConfigError(f"distribution: {self.distribution!r} is not one of {', '.join(DISTRIBUTIONS)}")
        if not isinstance(self.outage, bool):
            raise ConfigError(f"outage: {self.outage!r} is neither true nor false")


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

    arrived --> [ serialised at the bandwidth ] --> [ + delay + jitter ] --> due, in order

    Jitter is drawn once a segment of the byte stream, one uniform number each, so a draw depends on
    seed, connection, direction and segment number alone: not on how the stream was cut into chunks,
    nor on the conditions before. Messages smaller than a segment can therefore share a draw.
    Assigning `conditions` applies them to later chunks.
    """

    def __init__(self, conditions: LinkConditions, seed: int, connection: int, direction: str) -> None:
        self.conditions = conditions
        self._random = random.Random(f"{seed}/{connection}/{direction}")
        self._draw = 0.5
        self._segment_left = 0  # bytes of the current segment still to come
        self._busy_until_s = -math.inf
        self._last_due_s = -math.inf

    def due(self, arrived_s: float, size: int) -> float:
        """When the last of the next `size` bytes comes out, unless an outage holds it longer."""
        sent_s = max(arrived_s, self._busy_until_s)
        due_s = self._last_due_s
        if size == 0:  # the end of the stream travels too
            due_s = max(due_s, sent_s + self._delay_s())
        left = size
        while left:
            part = min(left, self._next_segment())
            self._segment_left -= part
            left -= part
            sent_s += self._serialisation_s(part)
            due_s = max(due_s, sent_s + self._delay_s())
        self._busy_until_s, self._last_due_s = sent_s, due_s
        return due_s

    def _next_segment(self) -> int:
        """Bytes to come in the current segment, starting the next one where it is over."""
        if not self._segment_left:
            self._segment_left = SEGMENT_BYTES
            self._draw = min(1 - self._random.random(), 1 - 2**-53)  # quantiles of 0 and 1 are infinite
        return self._segment_left

    def _delay_s(self) -> float:
        jitter_ms = self.conditions.jitter_ms
        if jitter_ms:
            jitter_ms *= DISTRIBUTIONS[self.conditions.distribution](self._draw)
        return max(0.0, self.conditions.delay_ms + jitter_ms) / 1e3

    def _serialisation_s(self, size: int) -> float:
        bandwidth_mbps = self.conditions.bandwidth_mbps
        return size * 8 / (bandwidth_mbps * 1e6) if bandwidth_mbps else 0.0


def _changed(direction: str, conditions: LinkConditions, changes: Mapping[str, Any]) -> LinkConditions:
    known = [f.name for f in fields(LinkConditions)]
    for name in changes:
        if name not in known:
            raise ConfigError(f"{name}: unknown condition; known: {', '.join(known)}, up, down")
    try:
        return replace(conditions, **changes)
    except ConfigError as error:
        raise ConfigError(f"{direction}.{error}") from None


def _check_number(name: str, value: object, most: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and 0 <= value <= most):  # type: ignore[operator]
        raise ConfigError(f"{name}: {value!r} is not a number from 0 to {most:g}")
