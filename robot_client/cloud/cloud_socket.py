"""The ZMQ socket of a remote site: its options, its encryption, and the events of its connection.

A host name may have an IPv4 address, an IPv6 address, or both, and libzmq looks for one kind only. After an
attempt that failed, the socket looks for the other kind.

What is sent on it, and when, is decided in `cloud`.
"""

import contextlib
import logging
import math
import time
from collections.abc import Iterator, Sequence
from enum import Enum, auto
from functools import lru_cache
from typing import Any

import zmq
import zmq.utils.monitor

from offboard.common.errors import ConfigError
from offboard.common.security.address import on_loopback
from offboard.common.security.keys import RobotKeys
from offboard.common.wire.channel import Channel, make_context, readable
from offboard.robot_client.cloud import connection
from offboard.robot_client.cloud.connection import HandshakeFailure
from offboard.robot_client.sites.endpoint import host_and_port

MESSAGE_BYTES_MAX = 256 * 1024 * 1024
SEND_QUEUE_MAX = 1000  # messages
RECONNECT_MS, RECONNECT_MAX_MS = 100, 1000
# The kernel asks again after 1, 3, 7, 15 and 31 s. Each attempt is short, so that the next one begins soon.
CONNECT_MS = 2000
OTHER_FAMILY_S = 1.0  # at least, for which one kind of address is tried
# TCP alone may take a quarter of an hour to notice that the server vanished without a word. The heartbeats
# of ZMQ would wait behind a large argument, and break a slow link that works.
UNACKNOWLEDGED_MS = 15_000
KEEPALIVE_IDLE_S, KEEPALIVE_EVERY_S, KEEPALIVE_PROBES = 10, 5, 2

log = logging.getLogger(__name__)


class CloudSocket(Channel):
    """A DEALER that connects to `endpoint` by itself. With `keys`, only to the server of that key.

    ConfigError if libzmq does not take the endpoint, OffloadError if the process lacks files or threads.
    """

    def __init__(self, site: str, endpoint: str, keys: RobotKeys | None) -> None:
        self._endpoint = endpoint
        self._events = _EVENTS if keys is not None else _EVENTS | _WITHOUT_KEYS
        named = "[" not in endpoint and any(map(str.isalpha, endpoint.removeprefix("tcp://")))
        self._other_family_s = -math.inf if named else math.inf  # when the other kind of address may be tried
        self._context = make_context(f"{site}: endpoint {endpoint!r}")
        try:
            self._dealer = _dealer(self._context, endpoint, keys)
            self._monitor = self._dealer.get_monitor_socket(sum(_EVENTS) | zmq.EVENT_CONNECT_RETRIED)
            self._dealer.connect(endpoint)
            super().__init__(self._dealer, self._monitor.FD)
        except (zmq.ZMQError, OSError) as error:
            self._context.destroy(linger=0)
            raise ConfigError(f"{site}: endpoint {endpoint!r}: {error}") from error
        if keys is None:
            _warn_of_plain_text(site, endpoint)

    def events(self) -> "Iterator[SocketEvent | HandshakeFailure]":
        """What happened to the connection since the last call."""
        if not self.watched_ready:
            return
        self.watched_ready = False
        last = 0
        while readable(self._monitor):
            message = zmq.utils.monitor.recv_monitor_message(self._monitor)
            last = int(message["event"])
            if last in _EVENTS:
                self._stay()
                yield _ONE_WITH_KEYS if (last, message["value"]) == _MISMATCH else self._events[last]
        if last == zmq.EVENT_CONNECT_RETRIED:
            self._try_other_family()

    def connect_again(self) -> None:
        with contextlib.suppress(zmq.ZMQError):  # there may be no connection to end
            self._dealer.disconnect(self._endpoint)
        self._dealer.connect(self._endpoint)

    def try_send(self, frames: Sequence[Any]) -> bool:
        """Send without waiting. False if there is no connection, or the queue of the socket is full."""
        try:
            self.send(frames)
        except zmq.Again:
            return False
        return True

    def close(self, linger_ms: int = 0) -> None:
        """Close, at the latest after this time for the messages that were not sent yet."""
        self._dealer.disable_monitor()
        self._context.destroy(linger=linger_ms)
        super().close()

    def _try_other_family(self) -> None:
        if time.monotonic() >= self._other_family_s:
            self._stay()
            self._dealer.ipv6 = not self._dealer.ipv6
            self.connect_again()

    def _stay(self) -> None:
        """Keep the kind of address for a while."""
        self._other_family_s = max(self._other_family_s, time.monotonic() + OTHER_FAMILY_S)


class SocketEvent(Enum):
    HANDSHAKE_SUCCEEDED = auto()
    DISCONNECTED = auto()


_EVENTS: dict[int, SocketEvent | HandshakeFailure] = {
    zmq.EVENT_HANDSHAKE_SUCCEEDED: SocketEvent.HANDSHAKE_SUCCEEDED,
    zmq.EVENT_DISCONNECTED: SocketEvent.DISCONNECTED,
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: HandshakeFailure(connection.UNKNOWN_ROBOT, final=True),
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: HandshakeFailure(connection.NO_HANDSHAKE, final=True),
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: HandshakeFailure(connection.NO_HANDSHAKE, final=False),
}
_WITHOUT_KEYS: dict[int, SocketEvent | HandshakeFailure] = {
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: HandshakeFailure(connection.BROKEN_HANDSHAKE, final=True),
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: HandshakeFailure(connection.BROKEN_HANDSHAKE, final=False),
}
_MISMATCH = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_ONE_WITH_KEYS = HandshakeFailure(connection.ONE_WITH_KEYS, final=True)


def _dealer(context: "zmq.Context[Any]", endpoint: str, keys: RobotKeys | None) -> "zmq.Socket[bytes]":
    dealer: zmq.Socket[bytes] = context.socket(zmq.DEALER)
    dealer.linger = 0
    dealer.ipv6 = "[" in endpoint
    dealer.immediate = True  # a request never waits for a connection: it would arrive with its budget gone
    dealer.sndhwm = dealer.rcvhwm = SEND_QUEUE_MAX
    dealer.reconnect_ivl, dealer.reconnect_ivl_max = RECONNECT_MS, RECONNECT_MAX_MS
    dealer.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_MS)
    dealer.setsockopt(zmq.TCP_MAXRT, UNACKNOWLEDGED_MS)
    dealer.setsockopt(zmq.TCP_KEEPALIVE, 1)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_IDLE_S)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_INTVL, KEEPALIVE_EVERY_S)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_CNT, KEEPALIVE_PROBES)
    dealer.maxmsgsize = MESSAGE_BYTES_MAX
    if keys is not None:
        dealer.curve_publickey, dealer.curve_secretkey = keys.own.public, keys.own.secret
        dealer.curve_serverkey = keys.server
    return dealer


@lru_cache(maxsize=256)  # once for each server, even if many offloaders connect to it
def _warn_of_plain_text(site: str, endpoint: str) -> None:
    """Log a warning unless the server is on this computer."""
    if not on_loopback(host_and_port(endpoint)[0]):
        text = "%s: %s without keys: anybody on the network path can read and change what is sent; "
        log.warning(text + "remedy: robot-client keys", site, endpoint)
