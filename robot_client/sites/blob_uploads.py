"""Which large arguments go to the server inside the request, and which by digest.

An argument that goes by digest is a blob: the server asks for its bytes only if it does not have them. That
saves sending the same bytes twice, and costs a hash on both sides and, for new bytes, a message of its own.
Images and scans are new every time, so they are better sent inside the request. Sending is left to `cloud`.
"""

from collections import Counter, OrderedDict

from offboard.common.wire.messages import Body

KEPT = 1024  # digests, and samples, that are remembered
NEW_AFTER = 2  # tasks of a kind in a row that had a new argument, before new arguments go inside the request
SAMPLE_BYTES = 64  # taken of an argument to recognise it; two arguments with equal samples may still differ
INLINE_BYTES_MAX = 16 * 1024 * 1024  # of the arguments of one task
INLINE_SHARE = 0.5  # of the largest message that the server takes, for the same


class BlobUploads:
    """Remembers what one connection has carried. Only `inline_rule` may be called without a lock."""

    def __init__(self) -> None:
        self._last_message: OrderedDict[bytes, int] = OrderedDict()  # the number of it, by digest
        self._new_in_a_row: Counter[str] = Counter()  # tasks with a new argument, by kind
        self._samples: OrderedDict[bytes, None] = OrderedDict()

    def forget(self) -> None:
        """The connection has ended, and the next one may lead to another server."""
        self._last_message.clear()

    def unknown(self, body: Body) -> list[bytes]:
        """The digests of `body` that this connection has not carried."""
        return [digest for digest in body.blobs if digest not in self._last_message]

    def sent(self, digest: bytes, message: int) -> None:
        """The message of this number carried the blob."""
        self._last_message[digest] = message
        if len(self._last_message) > KEPT:
            self._last_message.popitem(last=False)

    def carried_after(self, digest: bytes, message: int) -> bool:
        """Whether a message after the one of this number carried the blob."""
        return self._last_message.get(digest, 0) > message

    def probably_carried(self, raw: memoryview) -> bool:
        """Whether an argument like this one was sent before: its length and some of its bytes are equal."""
        return _sample(raw) in self._samples

    def often_new(self, kind: str) -> bool:
        return self._new_in_a_row[kind] >= NEW_AFTER

    def found(self, kind: str, *, new: bool) -> None:
        """Note whether the server lacked a blob of a task of this kind."""
        self._new_in_a_row[kind] = self._new_in_a_row[kind] + 1 if new else 0

    def inline_rule(self, kind: str, message_bytes_max: int) -> "InlineRule":
        """The rule for the arguments of one task of this kind."""
        bytes_max = min(INLINE_BYTES_MAX, INLINE_SHARE * message_bytes_max)
        return InlineRule(self._samples, bytes_max if self.often_new(kind) else 0)


class InlineRule:
    """Called with each large argument of one task: says whether its bytes go inside the request.

    They do if the argument is certainly new, and all such arguments together have at most `bytes_max` bytes.
    """

    def __init__(self, samples: "OrderedDict[bytes, None]", bytes_max: float) -> None:
        self._samples = samples
        self._bytes_max = bytes_max
        self._bytes = 0

    def __call__(self, raw: memoryview) -> bool:
        sample = _sample(raw)
        new = sample not in self._samples
        self._samples[sample] = None
        self._samples.move_to_end(sample)
        if len(self._samples) > KEPT:
            self._samples.popitem(last=False)
        if not new or self._bytes + raw.nbytes > self._bytes_max:
            return False
        self._bytes += raw.nbytes
        return True

    @property
    def used(self) -> bool:
        return self._bytes > 0


def _sample(raw: memoryview) -> bytes:
    """The length of an argument and a few of its bytes."""
    # The step is odd, so that in numbers of 8 bytes each byte has its turn.
    step = raw.nbytes // SAMPLE_BYTES | 1
    return b"%d:%b" % (raw.nbytes, raw[::step].tobytes())
