"""The content of a memory file: JSON, checked as a whole before any of it is used.

When the file is read and written is in `store`.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from offboard.common import VERSION as SOFTWARE
from offboard.common.tasks import Size
from offboard.robot_client.learning.site import Observation
from offboard.robot_client.predictors.base import REMEMBERED
from offboard.robot_client.sites.runner import Condition

FORMAT = 2  # version of the file: a file of another version is not read
NUMBER_MAX = 1e50  # and its inverse: squares and quotients stay in the range of a float
PER_SIZE, PER_WORK = "size", "work"


@dataclass(frozen=True, slots=True)
class KeptSite:
    """The last observations of one kind on one site, oldest first; `saved_at` is a Unix time.

    `source`: the hash of the source of what the site runs: the kind, or the variant of the site.
    """

    saved_at: float
    source: str
    observations: tuple[Observation, ...]


@dataclass(frozen=True, slots=True)
class KeptKind:
    """What is kept of one kind.

    `source`: its hash, as in a `hello`. `per`: PER_SIZE or PER_WORK, the unit of its amounts.
    `worked`: pairs of size and work.
    """

    source: str
    per: str
    worked: tuple[tuple[float, float], ...]
    sites: dict[str, KeptSite]


class Unreadable(Exception):
    """The file is not a memory file, or it is damaged; the text says why."""


def encode(kinds: Mapping[str, KeptKind]) -> bytes:
    """The bytes of a file that holds these kinds."""
    whole = {
        "v": FORMAT,
        "software": SOFTWARE,
        "kinds": {name: asdict(kind, dict_factory=_plain) for name, kind in kinds.items()},
    }
    return json.dumps(whole, separators=(",", ":")).encode() + b"\n"


def _plain(fields: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {name: one._asdict() if isinstance(one, Condition) else one for name, one in fields}


def decode(text: bytes) -> dict[str, KeptKind]:
    """The kinds that a file holds; Unreadable unless every part of it is valid."""
    try:
        whole = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Unreadable(f"not JSON: {error}") from None
    if not isinstance(whole, dict) or "v" not in whole or "kinds" not in whole:
        raise Unreadable("not a memory file of a robot-client")
    if whole["v"] != FORMAT:
        found = f"format version {whole['v']!r} of software {whole.get('software')!r}"
        raise Unreadable(f"{found}; this version reads {FORMAT}")
    try:
        return {name: _kind(kind) for name, kind in whole["kinds"].items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise Unreadable(f"{type(error).__name__}: {error}") from None


def _kind(given: Any) -> KeptKind:
    if given["per"] not in (PER_SIZE, PER_WORK):
        raise ValueError(f"amounts per {given['per']!r}")
    worked = [(_number(size), _number(work)) for size, work in given["worked"]]
    source = str(given["source"])
    sites = {name: _site(site, source) for name, site in given["sites"].items()}
    return KeptKind(source, given["per"], tuple(worked[-REMEMBERED:]), sites)


def _site(given: Any, kind_source: str) -> KeptSite:
    """A file from before there were variants has no source for each site."""
    observations = [_observation(one) for one in given["observations"]]
    source = str(given.get("source", kind_source))
    return KeptSite(_number(given["saved_at"]), source, tuple(observations[-REMEMBERED:]))


def _observation(given: Any) -> Observation:
    readers = {one.name: _READERS[one.type] for one in fields(Observation)}
    readers["predicted_s"] = _signed
    return Observation(**{name: read(given[name]) for name, read in readers.items()})


def _condition(given: Any) -> Condition:
    given = {"queue_s": 0.0, **given}  # files of 0.2.0 before it was measured lack it
    unknown = given.keys() - set(Condition._fields)
    if unknown:
        raise ValueError(f"unknown condition {sorted(unknown)[0]!r}")
    found = {name: _READERS[of](given[name]) for name, of in Condition.__annotations__.items()}
    if not 0 < found["capacity"] <= 1:
        raise ValueError(f"{found['capacity']} where a share above 0 to 1 was expected")
    return Condition(**found)


def _size(given: Any) -> Size:
    return tuple(map(_number, given)) if isinstance(given, list) and len(given) > 1 else _number(given)


def _number(given: Any, least: float = 1 / NUMBER_MAX) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError(f"{given!r} where a number was expected")
    if given != 0 and not least <= given <= NUMBER_MAX:
        raise ValueError(f"{given!r:.40} where 0 or a number from {least:g} to {NUMBER_MAX:g} was expected")
    return float(given)


def _maybe(given: Any) -> float | None:
    return None if given is None else _number(given)


def _signed(given: Any) -> float | None:
    """A prediction, which may be below 0."""
    return None if given is None else _number(given, -NUMBER_MAX)


def _fact(given: Any) -> bool:
    if not isinstance(given, bool):
        raise TypeError(f"{given!r} where true or false was expected")
    return given


_READERS: dict[Any, Callable[[Any], Any]] = {  # by the type of a field
    float: _number,
    float | None: _maybe,
    int: lambda given: int(_number(given)),
    bool: _fact,
    Size: _size,
    Condition: _condition,
}
