"""What is sent to robots: never waits, and holds no more for a robot than it may leave unread."""

from collections.abc import Callable

import zmq

from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.unsent_replies import LARGE_BYTES, Unsent
from offboard.common.wire.channel import Channel
from offboard.common.wire.messages import Message, byte_count, pack


class Outbox:
    """Used under the channel's lock. `knows`: whether a robot is still one of ours."""

    def __init__(
        self, channel: Channel, metrics: Metrics, message_bytes_max: int, knows: Callable[[bytes], bool]
    ) -> None:
        self._channel = channel
        self._metrics = metrics
        self._unsent = Unsent(message_bytes_max)
        self._knows = knows

    def send(self, peer: bytes, message: Message) -> None:
        """Send or drop: the robot may be gone, not reading, or not one of ours any more."""
        if not self._knows(peer):
            self._metrics.dropped.labels("unknown robot").inc()
            return
        frames = pack(message)
        size = byte_count(frames)
        if size > LARGE_BYTES:
            if not self._unsent.has_room(peer, size):
                self._metrics.dropped.labels("not reading").inc()
                return
            frames = self._unsent.tracked(peer, frames, size)
        try:
            self._channel.send([peer, *frames])
            self._metrics.bytes_out.inc(size)
        except zmq.Again:
            self._metrics.dropped.labels("not reading").inc()
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            self._metrics.dropped.labels("gone").inc()
