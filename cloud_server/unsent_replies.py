"""Large replies that libzmq still holds, as their robots do not read them."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import zmq

LARGE_BYTES = 64 * 1024  # smaller replies are bounded by their number
PEERS_MAX = 4096  # for which replies are remembered


class Unsent:
    """At most `bytes_max` of large replies are held for each robot; used by one thread at a time."""

    def __init__(self, bytes_max: int) -> None:
        self._bytes_max = bytes_max
        self._held: OrderedDict[bytes, list[tuple[zmq.MessageTracker, int]]] = OrderedDict()

    def has_room(self, peer: bytes, size: int) -> bool:
        held = [one for one in self._held.pop(peer, ()) if not one[0].done]
        if held:
            self._held[peer] = held
        return not held or sum(bytes_ for _, bytes_ in held) + size <= self._bytes_max

    def tracked(self, peer: bytes, frames: Sequence[Any], size: int) -> list[Any]:
        """The frames, of which the last one tells when libzmq lets go of it."""
        last = zmq.Frame(frames[-1], track=True, copy_threshold=0)
        assert last.tracker is not None
        self._held.setdefault(peer, []).append((last.tracker, size))
        while len(self._held) > PEERS_MAX:
            self._held.popitem(last=False)
        return [*frames[:-1], last]
