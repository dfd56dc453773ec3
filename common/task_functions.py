"""The functions that a task is made of: which ones are allowed, and what a caller gives them.

`tasks` registers them; what counts as their source is in `source`.
"""

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from offboard.common.errors import ConfigError

OPTIONS = ("deadline_s", "function", "observe", "timeout_s", "where")  # of a call, in this version or others


def check_ordinary(name: str, **functions: Callable[..., Any] | None) -> None:
    """ConfigError if one of the functions does not simply return its result."""
    for place, function in functions.items():
        for lazy in (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction):
            if lazy(function):
                raise ConfigError(
                    f"task {name}: {place} {name_of(function)} is a coroutine or generator function; "
                    "use an ordinary function that returns its result"
                )


def check_packing(name: str, pack: Any, unpack: Any) -> None:
    """ConfigError unless both are ordinary functions, or both None."""
    check_ordinary(name, pack=pack, unpack=unpack)
    if (pack is None) != (unpack is None):
        raise ConfigError(f"task {name}: pack= and unpack= need each other; give both or none")
    for place, one in (("pack", pack), ("unpack", unpack)):
        if one is not None and not callable(one):
            raise ConfigError(f"task {name}: {place}= is {one!r:.80}; it must be a function")


def check_parameters(name: str, parameters: Iterable[inspect.Parameter]) -> None:
    for parameter in parameters:
        if parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_KEYWORD):
            raise ConfigError(
                f"task {name}: parameter {parameter.name!r} is keyword-only; make it positional"
            )
        if parameter.name in OPTIONS:
            raise ConfigError(
                f"task {name}: a parameter cannot be named {parameter.name!r}, "
                "an option of the call; rename it"
            )


def check_first_parameter(name: str, signature: inspect.Signature) -> None:
    first = next(iter(signature.parameters.values()), None)
    if first is None or first.kind not in (first.POSITIONAL_ONLY, first.POSITIONAL_OR_KEYWORD):
        raise ConfigError(f"task {name}: setup= needs a function whose first parameter takes its result")


def check_variant(
    name: str, site: str, function: Callable[..., Any], *, setup: object, given: inspect.Signature
) -> None:
    """ConfigError unless a caller gives this variant of a task what the task itself is `given`."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError) as error:  # many functions of C libraries have none
        raise ConfigError(f"task {name}: the variant of {site!r} has no signature: {error}") from error
    if setup is not None:
        check_first_parameter(name, signature)
    wanted, found = _shown(given), _shown(without_state(signature, setup))
    if wanted != found:
        raise ConfigError(
            f"task {name}: the variant of {site!r}, {name_of(function)}, takes {found}, "
            f"but the task takes {wanted}"
        )


def _shown(signature: inspect.Signature) -> str:
    """The parameters with their defaults, as in `(frame, scale=2)`; annotations do not count."""
    bare = [one.replace(annotation=inspect.Parameter.empty) for one in signature.parameters.values()]
    return str(signature.replace(parameters=bare, return_annotation=inspect.Signature.empty))


def without_state(signature: inspect.Signature, setup: object) -> inspect.Signature:
    """What a caller gives: all parameters, without the first one if there is a setup."""
    if setup is None:
        return signature
    _, *given = signature.parameters.values()
    return signature.replace(parameters=given)


def name_of(function: object) -> str:
    return getattr(function, "__qualname__", None) or repr(function)
