"""A relay that applies toxics: each connection has those that its own random draws gave it.

The link conditions that toxics make are computed in `toxics.py`.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.relay import Refusal, Relay
from offboard.loadgen.relay.toxiproxy.toxics import Toxic, closes_after_s, link_of


class ToxicRelay(Relay):
    """Accepts connections while `taking`, and applies `toxics` to new connections and after each change."""

    def __init__(
        self, target: tuple[str, int], *, seed: int, connections_max: int, buffer_bytes: int
    ) -> None:
        super().__init__(
            target, Link(), seed=seed, connections_max=connections_max, buffer_bytes=buffer_bytes
        )
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
