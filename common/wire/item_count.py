"""Counts the items of a msgpack message before any of them is made, so that small ones are bounded too.

An item takes one byte of a message and up to a hundred bytes of memory, so a limit of bytes is not enough.
"""

from offboard.common.errors import OffloadError
from offboard.common.wire.blobs import Buffer, byte_length

ITEMS_MAX = 1_000_000  # of one value: each number, text, bytes, list, dict, key and array counts
TOO_MANY_ITEMS = (
    f"more than {ITEMS_MAX} items (numbers, texts, lists, dicts and their keys); "
    "make an array of a longer list of numbers"
)

# The msgpack format: how many bytes each first byte stands for. The items of a list or map follow it.
_SIZES = [1] * 256
_SIZES[0xA0:0xC0] = range(1, 33)  # short texts
_SIZES[0xCA:0xD4] = [5, 9, 2, 3, 5, 9, 2, 3, 5, 9]  # numbers
_SIZES[0xD4:0xD9] = [3, 4, 6, 10, 18]  # short extensions
_SIZES[0xDC:0xE0] = [3, 5, 3, 5]  # long lists and maps
# Long texts, bytes and extensions: the bytes that say how long, and those that come before the content.
_LENGTHS = {
    0xC4: (1, 2),
    0xC5: (2, 3),
    0xC6: (4, 5),
    0xC7: (1, 3),
    0xC8: (2, 4),
    0xC9: (4, 6),
    0xD9: (1, 2),
    0xDA: (2, 3),
    0xDB: (4, 5),
}
for _first in _LENGTHS:
    _SIZES[_first] = 0


def check_items(data: Buffer, name: str, error: type[OffloadError]) -> None:
    """Raise the error, about this name, if a message that is one piece of msgpack has too many items."""
    if byte_length(data) > ITEMS_MAX and count_items(data, ITEMS_MAX) > ITEMS_MAX:
        raise error(f"{name} has {TOO_MANY_ITEMS}")


def count_items(data: Buffer, most: int) -> int:
    """The items in msgpack of any origin, lists and maps included; counting stops after `most` + 1.

    An extension is one item, whatever it contains.
    """
    at = count = 0
    end, sizes = byte_length(data), _SIZES
    while at < end and count <= most:
        count += 1
        first = data[at]
        if size := sizes[first]:
            at += size
        else:
            wide, before = _LENGTHS[first]
            at += before + int.from_bytes(data[at + 1 : at + 1 + wide], "big")
    return count
