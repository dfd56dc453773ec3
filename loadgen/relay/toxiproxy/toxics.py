"""Toxiproxy's toxics, and the link conditions that they make together.

Pure. The relay that applies them is in `toxic_relay.py`. Names and meanings are those of
https://github.com/Shopify/toxiproxy#toxics
"""

import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from offboard.common.errors import OffloadError
from offboard.loadgen.relay.link.delay_samples import DELAY_MS_MAX
from offboard.loadgen.relay.link.link import (
    BANDWIDTH_MBPS_MAX,
    RESET_MS_MAX,
    TRUNCATE_BYTES_MAX,
    Link,
    LinkConditions,
)

DIRECTIONS = {"upstream": "up", "downstream": "down"}
KB_PER_S_MAX = BANDWIDTH_MBPS_MAX * 1e6 / 8 / 1e3
RESET_MS_MIN = 1  # in LinkConditions, 0 means never
# The attributes of each type, with their lowest and highest value. All are whole numbers; default 0.
ATTRIBUTES: dict[str, dict[str, tuple[float, float]]] = {
    "latency": {"latency": (0, DELAY_MS_MAX), "jitter": (0, DELAY_MS_MAX)},
    "bandwidth": {"rate": (0, KB_PER_S_MAX)},
    "slow_close": {"delay": (0, DELAY_MS_MAX)},
    "timeout": {"timeout": (0, RESET_MS_MAX)},
    "reset_peer": {"timeout": (0, RESET_MS_MAX)},
    "limit_data": {"bytes": (1, TRUNCATE_BYTES_MAX)},
}


class Refused(OffloadError):
    """A request that the Toxiproxy API refuses, with the text and the HTTP status of the reply."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class Toxic:
    """One effect on one stream (direction) of a proxy; `toxicity` is the share of connections that get it."""

    name: str
    type: str
    stream: str
    toxicity: float
    attributes: Mapping[str, int]

    def __post_init__(self) -> None:
        if self.stream not in DIRECTIONS:
            raise Refused("stream was invalid, can be either upstream or downstream")
        if self.type not in ATTRIBUTES:
            raise Refused(f"invalid toxic type: {self.type!r} is not one of {', '.join(ATTRIBUTES)}")
        if not 0 <= self.toxicity <= 1:
            raise Refused(f"bad request body: toxicity: {self.toxicity!r} is not a number from 0 to 1")

    def shown(self) -> dict[str, Any]:
        """The toxic as the API shows it."""
        names = ("name", "type", "stream", "toxicity", "attributes")
        return {name: getattr(self, name) for name in names}

    def strikes(self, seed: int, connection: int) -> bool:
        """Whether this connection gets the toxic.

        The draw does not depend on the toxicity, so a higher toxicity only adds connections.
        """
        return random.Random(f"{seed}/{connection}/{self.stream}/{self.name}").random() < self.toxicity


def attributes(
    type: str, given: Mapping[str, Any], before: Mapping[str, int] | None = None
) -> dict[str, int]:
    """All attributes of a type: the given value, or else the one before, or else 0.

    Unknown attributes are ignored, as Toxiproxy does.
    """
    known = ATTRIBUTES.get(type, {})
    values = {name: (before or {}).get(name, 0) for name in known}
    values |= {name: given[name] for name in known if given.get(name) is not None}
    for name, (least, most) in known.items():
        value = values[name]
        if not (isinstance(value, int) and not isinstance(value, bool) and least <= value <= most):
            allowed = f"a whole number from {least:.0f} to {most:.0f}"
            raise Refused(f"bad request body: {name}: {value!r} is not {allowed}")
    return values


def link_of(toxics: Iterable[Toxic]) -> Link:
    """The link that these toxics make together."""
    toxics = tuple(toxics)
    return Link(
        **{
            direction: _conditions([toxic for toxic in toxics if toxic.stream == stream])
            for stream, direction in DIRECTIONS.items()
        }
    )


def closes_after_s(toxics: Iterable[Toxic]) -> float | None:
    """After how long the timeout toxics among these close a connection; None means never."""
    times_ms = [toxic.attributes["timeout"] for toxic in toxics if toxic.type == "timeout"]
    return min((ms / 1e3 for ms in times_ms if ms), default=None)


def _conditions(toxics: Iterable[Toxic]) -> LinkConditions:
    """One direction under a chain of toxics: delays add up; the lowest limit and the first end count."""
    given: dict[tuple[str, str], list[int]] = {
        (type, name): [] for type, names in ATTRIBUTES.items() for name in names
    }
    for toxic in toxics:
        for name, value in toxic.attributes.items():
            given[toxic.type, name].append(value)
    timeouts, resets = given["timeout", "timeout"], given["reset_peer", "timeout"]
    return LinkConditions(
        delay_ms=float(sum(given["latency", "latency"])),
        jitter_ms=float(sum(given["latency", "jitter"])),
        distribution="uniform",
        bandwidth_mbps=min(filter(None, given["bandwidth", "rate"]), default=0) * 8e-3,
        slow_close_ms=float(sum(given["slow_close", "delay"])),
        hang=bool(timeouts or resets),  # both read bytes and deliver none
        reset_after_ms=float(min((max(ms, RESET_MS_MIN) for ms in resets), default=0)),
        truncate_bytes=min(given["limit_data", "bytes"], default=0),
    )
