"""What no hash covers, in words: above all the helpers that a task calls in its own module.

What is covered is in `covers`.
"""

import dis
import inspect
import sys
from collections.abc import Iterable, Iterator, Sequence
from types import CodeType
from typing import Any

from offboard.common.source.normal_form import function_of
from offboard.common.tasks import Kind, kinds

HELPERS_SHOWN = 20
LOADS = frozenset({"LOAD_GLOBAL", "LOAD_NAME"})


def not_compared(chosen: Sequence[Kind]) -> str:
    """What a comparison of these kinds on a robot leaves out."""
    helpers = uncovered(chosen)
    more = f" and {len(helpers) - HELPERS_SHOWN} more" if len(helpers) > HELPERS_SHOWN else ""
    called = f"{', '.join(helpers[:HELPERS_SHOWN])}{more} (called, but in no covers=); " if helpers else ""
    lacking = [one.name for kind in chosen for one in kind.variants.values() if _lacks_files(one)]
    files = f"{', '.join(lacking)} (its files are not on this robot); " if lacking else ""
    return f"{called}{files}constants, other modules, libraries, and files in no covers="


def _lacks_files(one: Kind) -> bool:
    return one.covers.files is not None and one.covers.files.lacking


def uncovered(chosen: Iterable[Kind]) -> list[str]:
    """Each function and class that one of these kinds calls and does not cover, once, as MODULE.NAME.

    Helpers of other modules, and those that are called through an attribute, are not found.
    """
    found = {name: None for kind in chosen for name in _uncovered(kind)}
    return list(found)


def _uncovered(kind: Kind) -> Iterator[str]:
    module = function_of(kind.function).__module__
    todo = [function_of(one) for one in _covered(kind)]
    seen = set(map(id, todo))
    compared = {id(function_of(one.function)) for one in kinds()}  # they have hashes of their own
    while todo:
        for one in _called(todo.pop()):
            if id(one) in seen or id(one) in compared or getattr(one, "__module__", None) != module:
                continue
            seen.add(id(one))
            todo.append(one)
            yield f"{module}.{one.__qualname__}"


def _covered(kind: Kind) -> Iterator[Any]:
    for one in (kind, *kind.variants.values()):
        given = (one.function, one.setup, one.pack, one.unpack, *one.types, *one.covers.code)
        yield from (part for part in given if part is not None)


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
