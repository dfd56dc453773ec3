"""Toxiproxy's toxics, the link conditions that they make together, and the relay that applies them.

Names and meanings are those of https://github.com/Shopify/toxiproxy#toxics
"""

import asyncio
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from offboard.common.errors import OffloadError
from offboard.loadgen.relay.link.link import (
    BANDWIDTH_MBPS_MAX,
    DELAY_MS_MAX,
    RESET_MS_MAX,
    TRUNCATE_BYTES_MAX,
    Link,
    LinkConditions,
)
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.relay import Refusal, Relay, RelaySettings

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
        return asdict(self)

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


class ToxicRelay(Relay):
    """Accepts connections while `taking`, and applies `toxics` to new connections and after each change.

    Each connection has the toxics that its own random draws gave it.
    """

    def __init__(self, target: tuple[str, int], settings: RelaySettings) -> None:
        super().__init__(target, Link(), settings)
        self.taking = False
        self.toxics: tuple[Toxic, ...] = ()
        self._toxic_connections: list[ToxicConnection] = []  # bounded by connections_max

    def accept(self) -> asyncio.BaseProtocol:
        if not self.taking:  # the kernel had accepted the connection before the listener was closed
            return Refusal()
        protocol = super().accept()
        for known in [one for one in self._toxic_connections if one.connection not in self.connections]:
            known.forget()
            self._toxic_connections.remove(known)
        for connection in self.connections:
            if connection.client is protocol:
                self._toxic_connections.append(ToxicConnection(connection, self.seed))
                self._toxic_connections[-1].take(self.toxics)
        return protocol

    def set_toxics(self, toxics: Sequence[Toxic]) -> None:
        """Apply these toxics to every connection, open or new, as the draws of the connection decide."""
        self.toxics = tuple(toxics)
        for known in self._toxic_connections:
            known.take(self.toxics)

    def close(self) -> None:
        """Accept no further connections, and end the open ones."""
        self.taking = False
        self.abort()


@dataclass(slots=True, eq=False)
class ToxicConnection:
    """One connection, the toxics that it has now, and the timer of a timeout toxic that closes it."""

    connection: Connection
    seed: int
    toxics: tuple[Toxic, ...] = ()
    end: asyncio.TimerHandle | None = None

    def take(self, toxics: Sequence[Toxic]) -> None:
        """Replace the toxics.

        As in Toxiproxy, removing a timeout toxic closes the connection, because its bytes were lost.
        """
        before, number = self.toxics, self.connection.number
        self.toxics = tuple(toxic for toxic in toxics if toxic.strikes(self.seed, number))
        if _timeouts(before) - _timeouts(self.toxics):
            self.connection.abort()
        elif before != self.toxics:
            self.connection.set_link(link_of(self.toxics))
        if closes_after_s(before) != closes_after_s(self.toxics):
            self._set_end(closes_after_s(self.toxics))

    def forget(self) -> None:
        """Cancel the timer: the connection has ended, or no timeout closes it any more."""
        if self.end is not None:
            self.end.cancel()
            self.end = None

    def _set_end(self, after_s: float | None) -> None:
        self.forget()
        if after_s is not None:
            self.end = asyncio.get_running_loop().call_later(after_s, self.connection.abort)


def _timeouts(toxics: Sequence[Toxic]) -> set[str]:
    return {toxic.name for toxic in toxics if toxic.type == "timeout"}
