"""The `@task` decorator, the registry of kinds, and loading the modules that register them.

`robot_client` decides where a task runs; `common.wire` sends it.
"""

import importlib
import inspect
import itertools
import math
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from offboard.common.dataclass_types import check_types, field_names
from offboard.common.errors import BadValue, ConfigError, UnknownTask, describe, is_interrupt

F = TypeVar("F", bound=Callable[..., Any])

NAME_LENGTH_MAX = 64
KINDS_MAX = 256  # a `hello` message names all of them
OPTIONS = ("deadline_s", "function", "observe", "timeout_s", "where")  # of a call, in this version or others
SIZE_NUMBERS_MAX = 8  # a size sums up the arguments; with more numbers, a window says too little of each

Size = float | tuple[float, ...]  # a tuple has 2 to SIZE_NUMBERS_MAX numbers


@dataclass(frozen=True, slots=True)
class Kind:
    """A registered function.

    `size` maps the arguments to the input size d: a number, or a tuple or list of them that always has the
    same length (each finite, >= 0). `types` are the dataclasses that arguments and result may contain. `warm`
    is called once per process before the first task. A kind with `duplicate=False` never runs on two sites.
    `work` maps a result to the amount of work that it took, in any unit. `setup` is called once per worker;
    its result is the first argument of the function, which callers do not give. `policy_server`: a policy
    server may answer too.
    """

    name: str
    function: Callable[..., Any]
    size: Callable[..., float | Sequence[float]]
    duplicate: bool = True
    types: tuple[type, ...] = ()
    warm: Callable[[], None] | None = None
    source_hash: str = ""
    work: Callable[[Any], float] | None = None
    positional: int | None = None  # a call with this many positional arguments needs no binding
    setup: Callable[[], Any] | None = None
    policy_server: bool = False
    _counts: list[int] = field(default_factory=list, compare=False, repr=False)  # the first one holds for all

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...]:
        """The call as positional arguments with defaults filled in. TypeError as if it were called."""
        if not kwargs and self.positional is not None and len(args) == self.positional:
            return args
        bound = self.signature().bind(*args, **kwargs)
        bound.apply_defaults()
        return bound.args

    def signature(self) -> inspect.Signature:
        """What a caller gives: the parameters of the function, without the first one if there is a setup."""
        return _without_state(inspect.signature(self.function), self.setup)

    def size_of(self, args: tuple[Any, ...]) -> Size:
        """The input size d of a call. BadValue unless it is finite, not negative and as long as before."""
        numbers = self._numbers(args)
        for number in numbers:
            if not (math.isfinite(number) and number >= 0):
                raise BadValue(f"task {self.name}: input size {number} is not a finite number >= 0")
        if self._counts != [len(numbers)]:
            self._check_count(len(numbers))
        return numbers if len(numbers) > 1 else numbers[0]

    @property
    def size_count(self) -> int | None:
        """How many numbers a size has; None before the first one."""
        return self._counts[0] if self._counts else None

    def _numbers(self, args: tuple[Any, ...]) -> tuple[float, ...]:
        try:
            given: Any = self.size(*args)
            if not isinstance(given, tuple | list):
                return (float(given),)
            numbers = tuple(map(float, given))
        except BaseException as error:  # the function is the user's own
            if is_interrupt(error):
                raise
            raise BadValue(f"task {self.name}: input size: {describe(error)}") from error
        if not 1 <= len(numbers) <= SIZE_NUMBERS_MAX:
            allowed = f"1 to {SIZE_NUMBERS_MAX} are allowed"
            raise BadValue(f"task {self.name}: input size has {len(numbers)} numbers; {allowed}")
        return numbers

    def _check_count(self, count: int) -> None:
        if not self._counts:
            self._counts.append(count)  # if two threads do this at once, the first one counts
        if self._counts[0] != count:
            before = f"{self._counts[0]} before; the count must not change"
            raise BadValue(f"task {self.name}: input size has {count} numbers, but had {before}")

    def work_of(self, result: Any) -> float | None:
        """The amount of work that a result took; None if it is unknown or not a number above 0."""
        if self.work is None:
            return None
        work = float(self.work(result))
        return work if math.isfinite(work) and work > 0 else None


@dataclass(frozen=True, slots=True)
class Task:
    """One call of a kind: its arguments and its input size."""

    kind: Kind
    args: tuple[Any, ...]
    size: Size
    id: int = field(default_factory=itertools.count(1).__next__)


_kinds: dict[str, Kind] = {}


def task(
    name: str,
    *,
    size: Callable[..., float | Sequence[float]],
    duplicate: bool = True,
    types: tuple[type, ...] = (),
    warm: Callable[[], None] | None = None,
    work: Callable[[Any], float] | None = None,
    setup: Callable[[], Any] | None = None,
    policy_server: bool = False,
) -> Callable[[F], F]:
    """Register a function as a kind of task. It can still be called as an ordinary function.

    Robot and server load the same module. If the source of the function, of its setup or of its dataclasses
    differs between them, the task stays onboard.
    If `size` returns several numbers, the predictor `least-squares` uses all of them, and every other one
    uses the first; `parts` predicts from the work instead if the kind tells it (by the first number too).
    With `policy_server`, policy servers may answer too: the function takes one observation and returns an
    action, and no source is compared.
    """
    if not name or len(name) > NAME_LENGTH_MAX or not name.isidentifier():
        raise ConfigError(f"task name {name!r} is not an identifier of at most {NAME_LENGTH_MAX} characters")
    if len(_kinds) >= KINDS_MAX:
        raise ConfigError(f"task {name}: {KINDS_MAX} tasks are registered already, the most allowed")

    check_types(name, types)

    def register(function: F) -> F:
        _check_ordinary(name, function=function, size=size, setup=setup, work=work, warm=warm)
        signature = inspect.signature(function)
        if setup is not None:
            _check_first_parameter(name, signature)
        parameters = _without_state(signature, setup).parameters.values()
        _check_parameters(name, parameters)
        fixed = all(parameter.kind != parameter.VAR_POSITIONAL for parameter in parameters)
        count = len(parameters) if fixed else None
        if policy_server and count != 1:
            raise ConfigError(
                f"task {name}: policy_server=True needs a function of one argument, the observation"
            )
        kind = Kind(
            name, function, size, duplicate,
            types=tuple(types), warm=warm, source_hash=_source_hash(function, setup, types), work=work,
            positional=count, setup=setup, policy_server=policy_server,
        )  # fmt: skip
        known = _kinds.get(name)
        if known is not None:
            _check_same(known, kind)
        _kinds[name] = kind
        return function

    return register


def first_number(size: Size) -> float:
    """The number of a size, or the first one of several."""
    return size[0] if isinstance(size, tuple) else size


def show_size(size: Size, form: str) -> str:
    """A size in words, with each number in this format."""
    numbers = size if isinstance(size, tuple) else (size,)
    return " and ".join(format(number, form) for number in numbers)


def kind_of(function: Callable[..., Any]) -> Kind:
    """The kind of this function. UnknownTask if the function is not registered."""
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
    """Import the modules that register tasks. ConfigError names a module that cannot be imported."""
    for name in names:
        meant = _meant(name)
        if meant != name:
            raise ConfigError(f"task module {name!r} is not the name of a module; did you mean {meant!r}?")
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:
            where = _where(name) if _is_missing(name, error) else ""
            raise ConfigError(f"task module {name!r} cannot be imported: {describe(error)}{where}") from error


def _meant(name: str) -> str:
    """The module that a file, or MODULE:FUNCTION, stands for; the same name if it is that of a module."""
    file = name.partition(":")[0].removesuffix(".py")
    parts = [part for part in file.split("/") if part.strip(".")]
    if not parts:
        return name
    return parts[-1] if file.startswith(("/", "..")) else ".".join(parts)


def _is_missing(name: str, error: BaseException) -> bool:
    """Whether the module itself was not found, rather than one that it imports."""
    return isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}.")


def _where(name: str) -> str:
    if name.startswith("examples."):
        return "; examples/ is only in a checkout: start the command in the folder of the checkout"
    return "; it is looked for in this folder and on PYTHONPATH"


def _check_ordinary(name: str, **functions: Callable[..., Any] | None) -> None:
    for place, function in functions.items():
        for lazy in (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction):
            if lazy(function):
                raise ConfigError(
                    f"task {name}: {place} {_name(function)} is a coroutine or generator function; "
                    "use an ordinary function that returns its result"
                )


def _check_parameters(name: str, parameters: Iterable[inspect.Parameter]) -> None:
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


def _check_same(known: Kind, kind: Kind) -> None:
    """ConfigError unless both are one function, whose module was loaded again or is also the script."""
    first, second = known.function, kind.function
    if _file(first) != _file(second) or _name(first) != _name(second):
        by = f"by {first.__module__}.{_name(first)} and by {second.__module__}.{_name(second)}"
    elif known.source_hash != kind.source_hash:
        by = "with different source"
    else:
        return
    raise ConfigError(f"task {kind.name} is registered twice, {by}; rename one of them")


def _file(function: Callable[..., Any]) -> str:
    module = function.__module__
    return getattr(sys.modules.get(module), "__file__", None) or module


def _name(function: Callable[..., Any] | None) -> str:
    return getattr(function, "__qualname__", None) or repr(function)


def _check_first_parameter(name: str, signature: inspect.Signature) -> None:
    first = next(iter(signature.parameters.values()), None)
    if first is None or first.kind not in (first.POSITIONAL_ONLY, first.POSITIONAL_OR_KEYWORD):
        raise ConfigError(f"task {name}: setup= needs a function whose first parameter takes its result")


def _without_state(signature: inspect.Signature, setup: object) -> inspect.Signature:
    if setup is None:
        return signature
    _, *given = signature.parameters.values()
    return signature.replace(parameters=given)


def _source_hash(function: Callable[..., Any], setup: Callable[[], Any] | None, types: Iterable[type]) -> str:
    """SHA-256 of the source of a function, its setup and its dataclasses, with the names of their fields.

    An empty text, which matches nothing, if the function has no source.
    """
    if not _source(function):
        return ""
    parts = [_source(function), _source(setup)]
    for one in types:
        parts += [_source(one), *sorted(field_names(one))]
    import hashlib  # it loads OpenSSL, which --help does not need

    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _source(of: Any) -> str:
    try:
        return textwrap.dedent(inspect.getsource(of))
    except (OSError, TypeError):
        return ""
