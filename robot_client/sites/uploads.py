"""Which large arguments a server has, as far as one connection tells, and which are better sent along.

Naming one by its digest saves sending it again, and costs its hash on both sides and, where it is new, a
message of its own. Images and scans are new every time.
"""

from collections import Counter, OrderedDict

from offboard.common.wire.messages import Body

KEPT = 1024  # digests, and samples, that are remembered
NEW_AFTER = 2  # tasks of a kind in a row with one that was new: then what is certainly new is sent along
SAMPLE_BYTES = 64  # of an argument; another one that differs in none of them may be the same
ALONG_BYTES_MAX = 16 * 1024 * 1024  # of one task,
ALONG_SHARE = 0.5  # and of the largest message that the server takes


class Uploads:
    """Not for several threads at once, but for `along` of one task beside the rest."""

    def __init__(self) -> None:
        self._numbers: OrderedDict[bytes, int] = OrderedDict()  # by digest, of the last message that had it
        self._new: Counter[str] = Counter()  # tasks of a kind in a row with something new
        self._samples: OrderedDict[bytes, None] = OrderedDict()

    def forget(self) -> None:
        """The connection is gone, and so may be the server."""
        self._numbers.clear()

    def unknown(self, body: Body) -> list[bytes]:
        """Digests of what this connection has not carried."""
        return [digest for digest in body.blobs if digest not in self._numbers]

    def sent(self, digest: bytes, number: int) -> None:
        """In the message of this number."""
        self._numbers[digest] = number
        if len(self._numbers) > KEPT:
            self._numbers.popitem(last=False)

    def carried_after(self, digest: bytes, number: int) -> bool:
        """Whether a later message than that had it."""
        return self._numbers.get(digest, 0) > number

    def often_new(self, kind: str) -> bool:
        return self._new[kind] >= NEW_AFTER

    def found(self, kind: str, *, new: bool) -> None:
        """The server did not have something of a task; or all."""
        self._new[kind] = self._new[kind] + 1 if new else 0

    def along(self, kind: str, message_bytes_max: int) -> "Along":
        """For the arguments of a task of this kind."""
        bytes_max = min(ALONG_BYTES_MAX, ALONG_SHARE * message_bytes_max)
        return Along(self._samples, bytes_max if self.often_new(kind) else 0)


class Along:
    """Called with each large argument of one task: whether it is sent along instead of named.

    Of what is certainly new at most `bytes_max`.
    """

    def __init__(self, samples: "OrderedDict[bytes, None]", bytes_max: float) -> None:
        self._samples = samples
        self._bytes_max = bytes_max
        self._bytes = 0

    def __call__(self, raw: memoryview) -> bool:
        every = raw.nbytes // SAMPLE_BYTES | 1  # odd: of numbers of 8 bytes each byte has its turn
        sample = b"%d:%b" % (raw.nbytes, raw[::every].tobytes())
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
