"""The hash of the source of a task, which a `hello` carries and a memory file keeps.

The form in which source is hashed is in `normal_form`, what it covers in `covers`.
"""

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from offboard.common.dataclass_types import field_names
from offboard.common.source.covers import Covers
from offboard.common.source.normal_form import normal_form

HASH_LENGTH = 64  # characters; the hash of covered files follows that of the source

Packing = tuple[Callable[..., Any] | None, Callable[..., Any] | None]  # pack and unpack


def source_hash(
    function: Callable[..., Any],
    setup: Callable[[], Any] | None,
    types: Iterable[type],
    packing: Packing,
    *,
    covers: Covers,
) -> str:
    """SHA-256 of the source of a function, its setup, its dataclasses with their fields, its packing, and
    what it covers, but for the contents of files.

    An empty text, which matches nothing, if the function has no source.
    """
    own = normal_form(function)
    if not own:
        return ""
    return _hash([own, normal_form(setup), *_sources(types, packing), *covers.texts()])


def contract_hash(
    signature: inspect.Signature, types: Iterable[type], packing: Packing, *, covers: Covers
) -> str:
    """SHA-256 of what all variants of a task share: what a caller gives, dataclasses, packing, covers.

    Defaults do not count: the robot fills them in.
    """
    given = [f"{one.kind.name} {one.name}" for one in signature.parameters.values()]
    return _hash(["variants", *given, *_sources(types, packing), *covers.texts()])


def _sources(types: Iterable[type], packing: Packing) -> list[str]:
    parts = [part for one in types for part in (normal_form(one), *sorted(field_names(one)))]
    return parts + [normal_form(one) for one in packing if one is not None]


def _hash(parts: Iterable[str]) -> str:
    import hashlib  # it loads OpenSSL, which --help does not need

    return hashlib.sha256("\0".join(parts).encode()).hexdigest()
