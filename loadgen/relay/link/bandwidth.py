"""The bandwidth limit of one direction: a token bucket.

When the bytes come out at the other end is put together in `pipe.py`.
"""

from offboard.loadgen.relay.link.link import SEGMENT_BYTES

CHUNK_BYTES = 8 * SEGMENT_BYTES  # largest bucket, so that the first bytes of a long read leave early
BUCKET_S = 0.001  # time that a full bucket takes at the bandwidth; the smallest bucket is one segment


class Bandwidth:
    """How long bytes take to send at `mbps` megabits per second; 0 is unlimited.

    `bucket_bytes` is the number of bytes that are sent together; None where the bandwidth is unlimited.
    An idle link saves up nothing: after a pause, a chunk takes its full sending time.
    """

    def __init__(self, mbps: float) -> None:
        self._s_per_byte = 8e-6 / mbps if mbps else 0.0
        self.bucket_bytes: int | None = None
        if self._s_per_byte:
            segments = int(BUCKET_S / (self._s_per_byte * SEGMENT_BYTES))
            self.bucket_bytes = max(1, min(CHUNK_BYTES // SEGMENT_BYTES, segments)) * SEGMENT_BYTES

    def sending_s(self, size: int) -> float:
        """How long `size` bytes take to send."""
        return size * self._s_per_byte
