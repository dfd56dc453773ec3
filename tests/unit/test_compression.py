"""Compressing bytes, and refusing compressed bytes that are not what they announce."""

import random
import sys
import tracemalloc
from typing import Any

import pytest

from offboard.common.errors import ProtocolError
from offboard.common.wire import compression
from offboard.common.wire.compression import ZSTD, compress, compressions, decompress

SIZE = 200_000
DATA = bytes(random.Random(1).choices(range(8), k=SIZE))  # 3 bits in each byte, without repetitions


def test_noise_of_few_values_shrinks_although_nothing_repeats() -> None:
    """This is what a noisy image is like; a byte of 3 bits takes less than half of its room."""
    assert compressions() == (ZSTD,)
    packed = compress(memoryview(DATA))
    assert len(packed) < SIZE / 2
    assert decompress(packed, SIZE) == DATA


@pytest.mark.parametrize("data", [b"", b"x", bytes(10_000_000), random.Random(2).randbytes(3_000_000)])
def test_all_bytes_come_back(data: bytes) -> None:
    """None, one, many equal ones, and bytes that cannot shrink."""
    assert decompress(compress(data), len(data)) == data


@pytest.mark.parametrize("size", [0, 1, SIZE - 1, SIZE + 1, 2**40])
def test_another_number_of_bytes_is_refused(size: int) -> None:
    """Both fewer and more than announced."""
    with pytest.raises(ProtocolError, match=f"does not have the {size} bytes"):
        decompress(compress(DATA), size)


def test_bytes_that_announce_too_little_take_no_memory() -> None:
    """A gigabyte of zeros in a few bytes is not unpacked beyond the size that was announced."""
    packed = compress(bytes(2**26))
    tracemalloc.start()
    with pytest.raises(ProtocolError):
        decompress(packed, 1000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**22


@pytest.mark.parametrize("change", ["cut", "more", "noise", "nothing", "twice"])
def test_damaged_bytes_are_refused(change: str) -> None:
    """Cut off, with more behind them, none at all, twice, or other bytes: each is a ProtocolError."""
    packed = compress(DATA)
    wrong = {
        "cut": packed[:-1],
        "more": packed + b"x",
        "noise": random.Random(3).randbytes(1000),
        "nothing": b"",
        "twice": packed * 2,
    }
    with pytest.raises(ProtocolError):
        decompress(wrong[change], SIZE)


def test_a_large_window_is_refused() -> None:
    """A frame may ask the reader for up to 128 MiB of memory; more than 8 MiB is refused."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    options: dict[Any, int] = {zstd.CompressionParameter.window_log: 27}
    writer = zstd.ZstdCompressor(options=options)
    packed = writer.compress(bytes(1000)) + writer.flush()  # the size is not known at the start
    with pytest.raises(ProtocolError, match="a compressed argument: "):
        decompress(packed, 1000)


def test_a_side_without_the_library_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """It announces no compression, and a compressed argument is a ProtocolError."""
    packed = compress(DATA)
    monkeypatch.setattr(compression, "_library", lambda: None)
    assert compressions() == ()
    with pytest.raises(ProtocolError, match="this side has no zstd"):
        decompress(packed, SIZE)
