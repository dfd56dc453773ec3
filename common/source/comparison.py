"""Whether a server may take a task of this robot: the hashes of its `hello` against those here.

Covered files are read on a robot at the first use of a task, on a server at its start. What no hash covers is
said in words: above all the helpers that a task calls in its own module.
"""

import dis
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import CodeType
from typing import Any

from offboard.common import VERSION
from offboard.common.source.covers import HASH_LENGTH, CoveredFiles
from offboard.common.source.normal_form import function_of
from offboard.common.tasks import Kind, kind_of, kinds
from offboard.common.variants import ONBOARD

SOFTWARE_SHOWN = 40  # characters of the version of the other side
HELPERS_SHOWN = 20
LOADS = frozenset({"LOAD_GLOBAL", "LOAD_NAME"})


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


def kind_in_use(function: Callable[..., Any]) -> Kind:
    """The kind of a function that a robot uses now: a thread begins to read the files that it covers.

    UnknownTask if the function is not registered, ConfigError if a file is missing.
    """
    kind = kind_of(function)
    if kind.variants or kind.covers.files is not None:
        for files, needed in _on_robot(kind):
            files.begin(needed=needed)
    return kind


def is_reading(kind: Kind) -> bool:
    """Whether files that the kind or one of its variants covers are being read."""
    return any(files.reading for files, _ in _on_robot(kind))


def read_files_of_robot(kind: Kind) -> None:
    """Read the files that the kind covers, and wait until that is done. ConfigError if one is missing."""
    for files, needed in _on_robot(kind):
        files.read(needed=needed)


def read_files_of_server() -> None:
    """Read the files that all tasks of a server cover. ConfigError if one is missing."""
    for kind in kinds():
        for one in (kind, *kind.on_servers()):
            if one.covers.files is not None:
                one.covers.files.read()


def _on_robot(kind: Kind) -> Iterator[tuple[CoveredFiles, bool]]:
    """The files of the kind and of its variants, and whether a robot needs them."""
    if kind.covers.files is not None:
        yield kind.covers.files, True
    for site, one in kind.variants.items():
        if one.covers.files is not None and one.present:
            yield one.covers.files, site == ONBOARD


def not_compared(chosen: Sequence[Kind]) -> str:
    """What a comparison of these kinds on a robot leaves out."""
    helpers = uncovered(chosen)
    more = f" and {len(helpers) - HELPERS_SHOWN} more" if len(helpers) > HELPERS_SHOWN else ""
    called = f"{', '.join(helpers[:HELPERS_SHOWN])}{more} (called, but in no covers=); " if helpers else ""
    variants = [one for kind in chosen for one in kind.variants.values()]
    lacking = [one.name for one in variants if one.covers.files is not None and one.covers.files.lacking]
    files = f"{', '.join(lacking)} (its files are not on this robot); " if lacking else ""
    return f"{called}{files}constants, other modules, libraries, and files in no covers="


def uncovered(chosen: Iterable[Kind]) -> list[str]:
    """Each function and class that one of these kinds calls and does not cover, once, as MODULE.NAME.

    Helpers of other modules, and those that are called through an attribute, are not found.
    """
    found = {name: None for kind in chosen for name in _uncovered(kind)}
    return list(found)


def _uncovered(kind: Kind) -> Iterator[str]:
    module = function_of(kind.function).__module__
    parts = [
        part
        for one in (kind, *kind.variants.values())
        for part in (one.function, one.setup, one.pack, one.unpack, *one.types, *one.covers.code)
    ]
    todo = [function_of(one) for one in parts if one is not None]
    seen = set(map(id, todo))
    compared = {id(function_of(one.function)) for one in kinds()}  # they have hashes of their own
    while todo:
        for one in _called(todo.pop()):
            if id(one) in seen or id(one) in compared or getattr(one, "__module__", None) != module:
                continue
            seen.add(id(one))
            todo.append(one)
            yield f"{module}.{one.__qualname__}"


def _called(of: Any) -> Iterator[Any]:
    """The functions and classes that the code of a function or class names."""
    for function in _functions(of):
        for name in _names(function.__code__):
            try:
                one = function_of(function.__globals__.get(name))
            except Exception:  # noqa: BLE001 - an object of the user that answers to every attribute
                continue
            if inspect.isclass(one) or inspect.isfunction(one):
                yield one


def _functions(of: Any) -> Iterator[Any]:
    if inspect.isfunction(of) or inspect.ismethod(of):
        yield of
    elif inspect.isclass(of) and of.__module__ in sys.modules:
        for member in vars(of).values():
            inner = getattr(member, "fget", None) or function_of(member)
            if inspect.isfunction(inner):
                yield inner


def _names(code: CodeType) -> Iterator[str]:
    """The global names that code reads, also in functions within it."""
    for one in dis.get_instructions(code):
        if one.opname in LOADS:
            yield str(one.argval)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
