"""Whether a server may take a task of this robot: the hashes of its `hello` against those here.

`source_hash` says what a hash covers.
"""

from collections.abc import Mapping

from offboard.common import VERSION
from offboard.common.source.source_hash import HASH_LENGTH
from offboard.common.tasks import Kind

SOFTWARE_SHOWN = 40  # characters of the version of the other side


def difference(kind: Kind, site: str, there: Mapping[str, str], software: str = VERSION) -> str | None:
    """Why the server of this site cannot take a kind, or not yet; None if it can.

    `there` has the hashes of its `hello`, `software` is its version of Offboard. If one side does not have
    the function or the files of a variant, only what all variants have in common is compared.
    """
    name, variant = kind.name, kind.at(site)
    if name not in there:
        return f"the server has no task {name}"
    if _other_source(kind, there[name]):
        if not kind.variants:
            covered = " or the code that it covers" if kind.covers.code else ""
            return f"the source of task {name}{covered} differs on the server{versions(software)}"
        if not any(one.name in there for one in kind.variants.values()):
            return f"task {name} has no variants on the server"
        shared = "the parameters, dataclasses, packing, version or covered functions"
        return f"{shared} of task {name} differ on the server{versions(software)}"
    if (why := _other_files(kind, there[name])) or variant is kind:
        return why
    known = there.get(variant.name)
    if known is None:
        return f"the server does not have {variant.name}, a variant of task {name}"
    if not variant.present:
        return None
    if _other_source(variant, known):
        what = f"the source of {variant.name}, a variant of task {name},"
        return f"{what} differs on the server{versions(software)}"
    return _other_files(variant, known)


def versions(software: str) -> str:
    """What is said of a difference in a hash if the other side runs another version of Offboard."""
    if software == VERSION:
        return ""
    there = ascii(software)[1:-1][:SOFTWARE_SHOWN]
    return f", or is only hashed in another way: Offboard {there} there, {VERSION} here"


def other_sources(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """The tasks that both sides have, and whose source has another hash there, or cannot be read."""
    return [
        name
        for name, known in there.items()
        if name in here and not here[name][:HASH_LENGTH] == known[:HASH_LENGTH] != ""
    ]


def _other_source(one: Kind, known: str) -> bool:
    return not one.source_hash or known[:HASH_LENGTH] != one.source_hash


def _other_files(one: Kind, known: str) -> str | None:
    """Why the files that a kind or variant covers are not known to be the same; None if they are."""
    files = one.covers.files
    if files is None or files.lacking:
        return None
    if files.fault:
        return files.fault
    if not files.digest:
        return f"the files that {one.name} covers are being read"
    if known[HASH_LENGTH:] != files.digest:
        names = [path.name for path in files.paths]
        which = names[0] if len(names) == 1 else f"one of the files {', '.join(names)}"
        return f"{which}, which {one.name} covers, differs on the server"
    return None
