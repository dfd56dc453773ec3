"""What can be run: the `@task` decorator, the registry of kinds, loading task modules by name.

Where a task runs is decided in `robot_client`; how it crosses the wire is `wire.messages`.
"""

import importlib
import inspect
import itertools
import math
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from offboard.common.errors import BadValue, ConfigError, UnknownTask, describe

F = TypeVar("F", bound=Callable[..., Any])

NAME_LENGTH_MAX = 64
KINDS_MAX = 256  # `hello` names them all


@dataclass(frozen=True, slots=True)
class Kind:
    """A registered function.

    `size` maps the function's arguments to the input size d (finite, >= 0); `types` are the dataclasses
    that its arguments and result may hold; `warm` is called once a process before the first task; a kind
    with `duplicate=False` is never run on two sites; `work` tells from a result how much work it was, in any
    unit.
    """

    name: str
    function: Callable[..., Any]
    size: Callable[..., float]
    duplicate: bool = True
    types: tuple[type, ...] = ()
    warm: Callable[[], None] | None = None
    source_hash: str = ""
    work: Callable[[Any], float] | None = None
    positional: int | None = None  # arguments of a call that needs no binding: all, by place

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...]:
        """The call as positional arguments, defaults filled in; TypeError as Python itself would say it."""
        if not kwargs and self.positional is not None and len(args) == self.positional:
            return args
        bound = inspect.signature(self.function).bind(*args, **kwargs)
        bound.apply_defaults()
        return bound.args

    def size_of(self, args: tuple[Any, ...]) -> float:
        """Input size d of a call; BadValue where the size function gives no finite number >= 0."""
        size = float(self.size(*args))
        if not (math.isfinite(size) and size >= 0):
            raise BadValue(f"task {self.name}: input size {size} is not a finite number >= 0")
        return size

    def work_of(self, result: Any) -> float | None:
        """The work that a result says it was; None where that is not told, or is no number above 0."""
        if self.work is None:
            return None
        work = float(self.work(result))
        return work if math.isfinite(work) and work > 0 else None


@dataclass(frozen=True, slots=True)
class Task:
    """One call of a kind: what to run, on what, and how big it is."""

    kind: Kind
    args: tuple[Any, ...]
    size: float
    id: int = field(default_factory=itertools.count(1).__next__)


_kinds: dict[str, Kind] = {}


def task(
    name: str,
    *,
    size: Callable[..., float],
    duplicate: bool = True,
    types: tuple[type, ...] = (),
    warm: Callable[[], None] | None = None,
    work: Callable[[Any], float] | None = None,
) -> Callable[[F], F]:
    """Register a function as a kind of task; it stays an ordinary function.

    The same module is loaded on both sides; a kind whose source differs there stays onboard.
    """
    if not name or len(name) > NAME_LENGTH_MAX or not name.isidentifier():
        raise ConfigError(f"task name {name!r} is not an identifier of at most {NAME_LENGTH_MAX} characters")
    if len(_kinds) >= KINDS_MAX:
        raise ConfigError(f"task {name}: {KINDS_MAX} tasks are registered already")

    def register(function: F) -> F:
        parameters = inspect.signature(function).parameters.values()
        for parameter in parameters:
            if parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_KEYWORD):
                raise ConfigError(f"task {name}: parameter {parameter.name!r} can only be given by keyword")
        fixed = all(parameter.kind != parameter.VAR_POSITIONAL for parameter in parameters)
        count = len(parameters) if fixed else None
        kind = Kind(name, function, size, duplicate, types, warm, _source_hash(function), work, count)
        known = _kinds.get(name)
        if known is not None and known.source_hash != kind.source_hash:
            raise ConfigError(f"task {name} is registered twice, with different source")
        _kinds[name] = kind
        return function

    return register


def kind_of(function: Callable[..., Any]) -> Kind:
    """The kind that `function` was registered as."""
    for kind in _kinds.values():
        if kind.function is function:
            return kind
    raise UnknownTask(f"{getattr(function, '__qualname__', function)} is not a task; decorate it with @task")


def kind_named(name: str) -> Kind:
    try:
        return _kinds[name]
    except KeyError:
        raise UnknownTask(f"no task named {name!r}; known: {', '.join(sorted(_kinds)) or 'none'}") from None


def is_kind(name: str) -> bool:
    return name in _kinds


def kinds() -> tuple[Kind, ...]:
    """All kinds registered in this process."""
    return tuple(_kinds.values())


def load_modules(names: Iterable[str]) -> None:
    """Import the modules that register tasks; ConfigError names one that cannot be imported."""
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:
            raise ConfigError(f"task module {name!r} cannot be imported: {describe(error)}") from error


def _source_hash(function: Callable[..., Any]) -> str:
    """SHA-256 of the function's source; empty, which equals no other, where the source is not to be had."""
    try:
        source = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        return ""
    import hashlib  # OpenSSL: not for who has no tasks, as --help

    return hashlib.sha256(source.encode()).hexdigest()
