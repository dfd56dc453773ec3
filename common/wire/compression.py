"""Compresses large arguments with Zstandard, and refuses compressed bytes that are not what they announce.

Python 3.14 has the library; for older versions `backports.zstd` is the same code.
"""

import sys
from typing import Any

from offboard.common.errors import ProtocolError
from offboard.common.wire.blobs import Buffer

ZSTD = "zstd"
LEVEL = 1  # the fastest level that also shortens bytes that do not repeat, such as those of a noisy image
WINDOW_LOG_MAX = 23  # of the memory for reading, 8 MiB; level 1 needs 512 KiB


def compressions() -> tuple[str, ...]:
    """The names of the libraries that this process has: none, or ZSTD."""
    return () if _library() is None else (ZSTD,)


def compress(data: Buffer) -> bytes:
    """The compressed data. Only for a process that has the library."""
    library = _library()
    assert library is not None, "compressions() says whether there is a library"
    compressed: bytes = library.compress(data, level=LEVEL)
    return compressed


def decompress(data: Buffer, size: int) -> bytes:
    """The `size` bytes that were compressed. ProtocolError unless they are exactly that many."""
    library = _library()
    if library is None:
        raise ProtocolError(f"an argument is compressed, and this side has no {ZSTD}")
    try:
        reader = library.ZstdDecompressor(
            options={library.DecompressionParameter.window_log_max: WINDOW_LOG_MAX}
        )
        found: bytes = reader.decompress(data, max_length=size + 1)  # one more shows that there are too many
    except library.ZstdError as error:
        raise ProtocolError(f"a compressed argument: {error}") from error
    if len(found) != size or not reader.eof or reader.unused_data:
        raise ProtocolError(f"a compressed argument does not have the {size} bytes that it announces")
    return found


def _library() -> Any:
    """The library; None if this Python was built without it, or if it is not installed."""
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError:
        return None
    return zstd
