"""A relay whose connections each have the toxics that their own draws gave them.

What toxics make of a link is `toxics.py`.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.relay import Refusal, Relay
from offboard.loadgen.relay.toxiproxy.toxics import Toxic, closes_after_s, link_of


class ToxicRelay(Relay):
    """Takes connections while `taking`, and puts `toxics` on each as it comes and whenever they change."""

    def __init__(
        self, target: tuple[str, int], *, seed: int, connections_max: int, buffer_bytes: int
    ) -> None:
        super().__init__(
            target, Link(), seed=seed, connections_max=connections_max, buffer_bytes=buffer_bytes
        )
        self.taking = False
        self.toxics: tuple[Toxic, ...] = ()
        self._struck: list[Struck] = []  # bounded as the connections are

    def accept(self) -> asyncio.BaseProtocol:
        if not self.taking:  # the kernel had accepted it before the listener was closed
            return Refusal()
        protocol = super().accept()
        for struck in [one for one in self._struck if one.connection not in self.connections]:
            struck.forget()
            self._struck.remove(struck)
        for connection in self.connections:
            if connection.client is protocol:
                self._struck.append(Struck(connection, self.seed))
                self._struck[-1].take(self.toxics)
        return protocol

    def set_toxics(self, toxics: Sequence[Toxic]) -> None:
        """Put these toxics on every connection, open or to come, as far as its draws say."""
        self.toxics = tuple(toxics)
        for struck in self._struck:
            struck.take(self.toxics)

    def close(self) -> None:
        """Take no connections, end those there are."""
        self.taking = False
        self.abort()


@dataclass(slots=True, eq=False)
class Struck:
    """One connection, the toxics it has now, and when a timeout among them closes it."""

    connection: Connection
    seed: int
    toxics: tuple[Toxic, ...] = ()
    end: asyncio.TimerHandle | None = None

    def take(self, toxics: Sequence[Toxic]) -> None:
        """As in Toxiproxy, a timeout that is taken away closes the connection: its bytes were lost."""
        before, number = self.toxics, self.connection.number
        self.toxics = tuple(toxic for toxic in toxics if toxic.strikes(self.seed, number))
        if _timeouts(before) - _timeouts(self.toxics):
            self.connection.abort()
        elif before != self.toxics:
            self.connection.set_link(link_of(self.toxics))
        if closes_after_s(before) != closes_after_s(self.toxics):
            self._set_end(closes_after_s(self.toxics))

    def forget(self) -> None:
        """The connection has ended, or shall not be closed at its time."""
        if self.end is not None:
            self.end.cancel()
            self.end = None

    def _set_end(self, after_s: float | None) -> None:
        self.forget()
        if after_s is not None:
            self.end = asyncio.get_running_loop().call_later(after_s, self.connection.abort)


def _timeouts(toxics: Sequence[Toxic]) -> set[str]:
    return {toxic.name for toxic in toxics if toxic.type == "timeout"}
