"""The socket of the robots: its options, and sending without waiting; `server` reads it."""

import os
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import zmq

from offboard.cloud_server.authorisation import ZAP_DOMAIN
from offboard.cloud_server.metrics import Metrics
from offboard.common.errors import ConfigError
from offboard.common.security.keys import KeyPair
from offboard.common.wire.channel import Channel
from offboard.common.wire.messages import Message, byte_count, pack

PEER_MESSAGES_MAX = 256  # unsent replies, and unread requests, of one connection
HANDSHAKE_S = 10.0  # until a new connection has finished its handshake
# A silent connection is dead after this many seconds, plus this many unanswered probes at this interval.
KEEPALIVE_IDLE_S, KEEPALIVE_EVERY_S, KEEPALIVE_PROBES = 60, 10, 6
LARGE_BYTES = 64 * 1024  # smaller replies are limited by their number, in the socket
PEERS_MAX = 4096  # connections whose unread replies are remembered


def bind_router(
    context: "zmq.Context[zmq.Socket[bytes]]", listen: str, message_bytes_max: int, keys: KeyPair | None
) -> "zmq.Socket[bytes]":
    """A ROUTER socket bound to `listen`; ConfigError if that is not possible."""
    router = context.socket(zmq.ROUTER)
    router.setsockopt(zmq.LINGER, 0)
    router.setsockopt(zmq.ROUTER_MANDATORY, 1)  # a reply that cannot be sent is an error, so it is counted
    router.setsockopt(zmq.MAXMSGSIZE, message_bytes_max)
    router.setsockopt(zmq.SNDHWM, PEER_MESSAGES_MAX)
    router.setsockopt(zmq.RCVHWM, PEER_MESSAGES_MAX)
    router.setsockopt(zmq.HANDSHAKE_IVL, int(HANDSHAKE_S * 1000))
    router.setsockopt(zmq.TCP_KEEPALIVE, 1)
    router.setsockopt(zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_IDLE_S)
    router.setsockopt(zmq.TCP_KEEPALIVE_INTVL, KEEPALIVE_EVERY_S)
    router.setsockopt(zmq.TCP_KEEPALIVE_CNT, KEEPALIVE_PROBES)
    router.setsockopt(zmq.IPV6, int("[" in listen))
    if keys is not None:
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # if nothing answered libzmq, no robot would be let in
    try:
        router.bind(listen)
    except zmq.ZMQError as error:
        router.close()
        context.term()
        raise ConfigError(f"--listen: {listen!r} cannot be bound: {os.strerror(error.errno or 0)}") from error
    return router


class ReplySender:
    """Sends messages on the channel; used under the lock of the channel.

    For each connection at most `message_bytes_max` of unread large replies are kept. `knows` tells whether a
    connection may still get messages.
    """

    def __init__(
        self, channel: Channel, metrics: Metrics, message_bytes_max: int, knows: Callable[[bytes], bool]
    ) -> None:
        self._channel = channel
        self._metrics = metrics
        self._unread_max = message_bytes_max
        # The large replies that libzmq still holds because their robots have not read them.
        self._held: OrderedDict[bytes, list[tuple[zmq.MessageTracker, int]]] = OrderedDict()
        self._knows = knows

    def send(self, peer: bytes, message: Message) -> None:
        """Send, or drop and count: the robot may be gone, may not read, or may have been removed."""
        if not self._knows(peer):
            self._metrics.dropped.labels("unknown robot").inc()
            return
        frames: list[Any] = pack(message)
        size = byte_count(frames)
        if size > LARGE_BYTES:
            held = self._held[peer] = [one for one in self._held.pop(peer, ()) if not one[0].done]
            if held and sum(bytes_ for _, bytes_ in held) + size > self._unread_max:
                self._metrics.dropped.labels("not reading").inc()
                return
            last = zmq.Frame(frames[-1], track=True, copy_threshold=0)
            assert last.tracker is not None
            held.append((last.tracker, size))  # libzmq reports when it has let go of the last frame
            frames = [*frames[:-1], last]
            if len(self._held) > PEERS_MAX:
                self._held.popitem(last=False)
        try:
            self._channel.send([peer, *frames])
            self._metrics.bytes_out.inc(size)
        except zmq.Again:
            self._metrics.dropped.labels("not reading").inc()
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            self._metrics.dropped.labels("gone").inc()
