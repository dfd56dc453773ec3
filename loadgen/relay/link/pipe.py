"""One direction of one connection: when bytes that arrive now come out at the other end.

Pure: time is an argument, and randomness comes from a seed. The sockets are in `relay/tcp`.
"""

import math

from offboard.loadgen.relay.link.draws import DISTRIBUTIONS, SAMPLES, Jitter, Loss, quantile, stall_ms
from offboard.loadgen.relay.link.link import SEGMENT_BYTES, LinkConditions

CHUNK_BYTES = 8 * SEGMENT_BYTES  # largest bucket, so that the first bytes of a long read leave early
BUCKET_S = 0.001  # time that a full bucket takes at the bandwidth; the smallest bucket is one segment


class Pipe:
    """Computes when the bytes of one direction of one connection are due.

    arrived --> [ sent at the bandwidth ] --> [ + delay + jitter + stall ] --> due, in order
                 or at recorded rates           recorded delay of the time when it began to be sent

    Jitter and loss are drawn once for each segment of the byte stream, each from its own random numbers. So
    a draw depends only on seed, connection, direction and segment number: not on how the stream was cut into
    chunks, on earlier conditions, or on other effects. Messages that are smaller than a segment can therefore
    share a draw. A lost segment stalls once, together with all of its bytes that arrived without a gap.

    The bandwidth limit is a token bucket. An idle link saves up nothing: after a pause, a chunk takes its
    full sending time.

    New `conditions` apply to later chunks.
    """

    def __init__(self, conditions: LinkConditions, seed: int, connection: int, direction: str) -> None:
        origin = f"{seed}/{connection}/{direction}"
        self._jitter = Jitter(origin)
        self._loss = Loss(origin)
        self.busy_until_s = -math.inf  # when the last byte so far is sent, before its delay
        self._last_due_s = -math.inf
        self._segment_stall_ms = 0.0
        self.taken = 0  # bytes
        self.drawn_ms = 0.0  # delay and jitter of the segment in which the last chunk ended
        self.stall_ms = 0.0  # longest stall of the segments of the last chunk
        self.conditions = conditions

    @property
    def conditions(self) -> LinkConditions:
        return self._conditions

    @conditions.setter
    def conditions(self, conditions: LinkConditions) -> None:
        self._conditions = conditions
        mbps, played = conditions.bandwidth_mbps, conditions.recording
        self._s_per_byte = 8e-6 / mbps if mbps else 0.0
        draws = conditions.varies or conditions.loss > 0
        single = draws or (played is not None and played.rate is not None)
        self.bucket_bytes = SEGMENT_BYTES if single else _bucket_bytes(self._s_per_byte)
        self._in_parts = draws or (played is not None and played.delays)  # which have delays of their own

    @property
    def segment(self) -> int:
        """The number of the segment that the next byte belongs to."""
        return self.taken // SEGMENT_BYTES

    def chunk_bytes(self, size: int) -> int:
        """How many of the next `size` bytes travel together, as one chunk.

        A chunk is one segment where the rate is recorded, and where each segment draws its own delay, so that
        a late segment does not hold those before it. Else a chunk is at most one bucket of the bandwidth.
        Without a bandwidth limit it is all `size` bytes.
        """
        if self.bucket_bytes is None:
            return size
        return min(size, self.bucket_bytes - self.taken % SEGMENT_BYTES)

    def left(self, size: int) -> int:
        """How many of the next `size` bytes come before the stream is truncated."""
        most = self._conditions.truncate_bytes
        return min(size, max(0, most - self.taken)) if most else size

    def due(self, arrived_s: float, size: int) -> float:
        """When the last of the next `size` bytes comes out; an outage may hold it longer.

        A size of 0 is the end of the stream.
        """
        if arrived_s > self.busy_until_s:  # bytes after a gap were not lost with the start of the segment
            self._segment_stall_ms = 0.0
        sent_s = max(arrived_s, self.busy_until_s)
        self.stall_ms = 0.0
        if size == 0:
            return self._end_due(sent_s)
        due_s = self._last_due_s
        left = size
        while left:
            part = self.chunk_bytes(left) if self._in_parts else left
            began_s = sent_s
            sent_s = self._sent_s(began_s, part)
            due_s = max(due_s, sent_s + self._late_s(began_s))
            self.taken += part
            left -= part
        self.busy_until_s, self._last_due_s = sent_s, due_s
        return due_s

    def _end_due(self, sent_s: float) -> float:
        """When the end of the stream comes out: as late as the last segment, and never lost."""
        self.drawn_ms = self._delay_ms(max(0, self.taken - 1) // SEGMENT_BYTES, sent_s)
        due_s = max(self._last_due_s, sent_s + self.drawn_ms / 1e3)
        return due_s + self._conditions.slow_close_ms / 1e3

    def _sent_s(self, began_s: float, size: int) -> float:
        """When the next `size` bytes are sent, if the first one begins then."""
        played = self._conditions.recording
        if played is not None and played.rate is not None:
            return played.sent_s(began_s, size)
        return began_s + size * self._s_per_byte

    def _delay_ms(self, segment: int, began_s: float) -> float:
        """Delay and jitter of a segment that began to be sent then; never less than 0."""
        now, fixed_ms = self._conditions, self._conditions.delay_at_ms(began_s)
        if not now.varies:
            return fixed_ms
        draw = self._jitter.at(segment, now.correlation)
        if now.distribution == SAMPLES:
            return fixed_ms + quantile(now.samples, draw)
        return max(0.0, fixed_ms + now.jitter_ms * DISTRIBUTIONS[now.distribution](draw))

    def _late_s(self, began_s: float) -> float:
        """Delay, jitter and stall of the next part of a segment."""
        self.drawn_ms = self._delay_ms(self.segment, began_s)
        if self.taken % SEGMENT_BYTES == 0:
            now = self._conditions
            times = self._loss.times(self.segment, now.loss, now.loss_burst)
            self._segment_stall_ms = stall_ms(times, now.stall_ms)
        self.stall_ms = max(self.stall_ms, self._segment_stall_ms)
        return (self.drawn_ms + self._segment_stall_ms) / 1e3


def _bucket_bytes(s_per_byte: float) -> int | None:
    """The number of bytes that are sent together; None where the bandwidth is unlimited."""
    if not s_per_byte:
        return None
    segments = int(BUCKET_S / (s_per_byte * SEGMENT_BYTES))
    return max(1, min(CHUNK_BYTES // SEGMENT_BYTES, segments)) * SEGMENT_BYTES
