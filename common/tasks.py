"""The `@task` decorator, and the registry of kinds."""

import inspect
import itertools
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Concatenate, Literal, ParamSpec, Protocol, TypeVar, overload

from offboard.common.dataclass_types import check_types
from offboard.common.errors import BadValue, ConfigError, UnknownTask, describe, is_interrupt
from offboard.common.source.covers import Covers, contract_hash, covers_by_site, covers_of, source_hash
from offboard.common.together import Together, by_site
from offboard.common.variants import (
    AT,
    CLOUD,
    ONBOARD,
    Variant,
    check_ordinary,
    check_packing,
    check_parameters,
    check_variant,
    elsewhere,
    given_to,
    group_of,
    name_of,
    variants_of,
    without_state,
)

F = TypeVar("F", bound=Callable[..., Any])
P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)

NAME_LENGTH_MAX = 64
KINDS_MAX = 256  # a `hello` message names all of them
SIZE_NUMBERS_MAX = 8  # a size sums up the arguments; with more numbers, a window says too little of each

ByTogether = Mapping[str, Together]  # by site
Size = float | tuple[float, ...]  # a tuple has 2 to SIZE_NUMBERS_MAX numbers


@dataclass(frozen=True, slots=True)
class Kind:
    """A registered function.

    `size` maps the arguments to the input size d: a number, or a tuple or list of them that always has the
    same length (each finite, >= 0). `types` are the dataclasses that arguments and result may contain. `warm`
    is called once per process before the first task. A kind with `duplicate=False` never runs on two sites.
    `work` maps a result to the amount of work that it took, in any unit. `setup` is called once per worker;
    its result is the first argument of the function, which callers do not give. `pack` makes one value of the
    arguments of a task that leaves the robot, and `unpack` makes the arguments of that value.

    `variants` holds a kind for each site, if sites run different functions, with the `quality` of its answers
    from 0 to 1. `source_hash` then covers what they have in common: parameters, dataclasses, pack and unpack.
    `covers` says what else counts as source; the contents of its files are no part of `source_hash`.
    `policy_server`: a policy server may answer too. `together`: how a server runs several requests at once.
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
    variants: "Mapping[str, Kind]" = field(default_factory=dict, compare=False)
    quality: float = 1.0
    pack: Callable[..., Any] | None = None
    unpack: Callable[[Any], Any] | None = None
    policy_server: bool = False
    covers: Covers = field(default_factory=Covers, compare=False)
    together: Together | None = None
    _counts: list[int] = field(default_factory=list, compare=False, repr=False)  # the first one holds for all

    def bind(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...]:
        """The call as positional arguments with defaults filled in. TypeError as if it were called."""
        if not kwargs and self.positional is not None and len(args) == self.positional:
            return args
        bound = self.signature().bind(*args, **kwargs)
        bound.apply_defaults()
        return bound.args

    def arguments_in(self, item: Any) -> tuple[Any, ...]:
        """The arguments in one item: a tuple holds all of them if the function takes several."""
        return item if isinstance(item, tuple) and self.positional != 1 else (item,)

    def signature(self) -> inspect.Signature:
        """What a caller gives: the parameters of the function, without the first one if there is a setup."""
        return without_state(inspect.signature(self.function), self.setup)

    def at(self, site: str) -> "Kind":
        """What this site runs: the kind itself or its variant. `cloud` stands for servers without one.

        Equal servers run the variant of their group.
        """
        if not self.variants:
            return self
        return self.variants.get(group_of(site)) or self.variants[CLOUD]

    def on_servers(self) -> "tuple[Kind, ...]":
        """What servers run: the kind itself, or those of its variants that this computer has."""
        if not self.variants:
            return (self,)
        return tuple(one for site, one in self.variants.items() if site != ONBOARD and one.present)

    @property
    def fingerprint(self) -> str:
        """What a `hello` says: the hash of the source, and then that of the covered files, once it is known.

        It is empty, and matches nothing, if the source cannot be read.
        """
        files = self.covers.files
        return self.source_hash + files.digest if self.source_hash and files is not None else self.source_hash

    @property
    def present(self) -> bool:
        return self.function is not elsewhere

    def size_of(self, args: tuple[Any, ...]) -> Size:
        """The input size d of a call. BadValue unless it is finite, not negative and as long as before."""
        numbers = self._numbers(args)
        for number in numbers:
            if not (math.isfinite(number) and number >= 0):
                raise BadValue(f"task {self.name}: input size {number} is not a finite number >= 0")
        if not self._counts:
            self._counts.append(len(numbers))  # if two threads do this at once, the first one counts
        if self._counts[0] != len(numbers):
            before = f"{self._counts[0]} before; the count must not change"
            raise BadValue(f"task {self.name}: input size has {len(numbers)} numbers, but had {before}")
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

    def work_of(self, result: Any) -> float | None:
        """The amount of work that a result took; None if it is unknown or not a number above 0."""
        if self.work is None:
            return None
        work = float(self.work(result))
        return work if math.isfinite(work) and work > 0 else None


@dataclass(frozen=True, slots=True)
class Task:
    """One call of a kind: its arguments and its input size.

    `compress`: the numbers of the arguments that are compressed on the way to the site.
    `parcel`: keeps its packed arguments for further sites, if its kind packs them.
    `useless_s`: when nobody needs the answer any more, on the clock of `time.perf_counter`; None: unknown.
    """

    kind: Kind
    args: tuple[Any, ...]
    size: Size
    id: int = field(default_factory=itertools.count(1).__next__)
    compress: tuple[int, ...] = ()
    parcel: Any = field(default=None, compare=False, repr=False)
    useless_s: float | None = None


class PlainTask(Protocol[P, R_co]):
    """What type checkers see of a task without `setup=`: any function."""

    @property
    def __code__(self) -> Any: ...

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class SetupTask(Protocol[P, R_co]):
    """What type checkers see of a task with `setup=`: an offloader calls it without its first argument.

    `takes_state` tells it from a plain one, and is there for type checkers only.
    """

    takes_state: Literal[True]

    def __call__(self, state: Any, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


_kinds: dict[str, Kind] = {}
_on_servers: dict[str, Kind] = {}  # by the name that a request has


@overload
def task(
    name: str, *, size: Callable[..., float | Sequence[float]], duplicate: bool = ...,
    types: tuple[type, ...] = ..., warm: Callable[[], None] | None = ...,
    work: Callable[[Any], float] | None = ..., setup: None = ...,
    variants: Mapping[str, Callable[..., Any] | None] | None = ..., quality: Mapping[str, float] | None = ...,
    pack: Callable[..., Any] | None = ..., unpack: Callable[[Any], Any] | None = ...,
    policy_server: bool = ..., version: str | int = ..., together: Together | ByTogether | None = ...,
    covers: Sequence[Any] | Mapping[str, Sequence[Any]] = ...,
) -> Callable[[F], F]: ...  # fmt: skip
@overload
def task(
    name: str, *, size: Callable[..., float | Sequence[float]], duplicate: bool = ...,
    types: tuple[type, ...] = ..., warm: Callable[[], None] | None = ...,
    work: Callable[[Any], float] | None = ..., setup: Callable[[], Any] | Mapping[str, Callable[[], Any]],
    variants: Mapping[str, Callable[..., Any] | None] | None = ..., quality: Mapping[str, float] | None = ...,
    pack: Callable[..., Any] | None = ..., unpack: Callable[[Any], Any] | None = ...,
    policy_server: bool = ..., version: str | int = ..., together: Together | ByTogether | None = ...,
    covers: Sequence[Any] | Mapping[str, Sequence[Any]] = ...,
) -> Callable[[Callable[Concatenate[Any, P], R_co]], SetupTask[P, R_co]]: ...  # fmt: skip
def task(
    name: str,
    *,
    size: Callable[..., float | Sequence[float]],
    duplicate: bool = True,
    types: tuple[type, ...] = (),
    warm: Callable[[], None] | None = None,
    work: Callable[[Any], float] | None = None,
    setup: Callable[[], Any] | Mapping[str, Callable[[], Any]] | None = None,
    variants: Mapping[str, Callable[..., Any] | None] | None = None,
    quality: Mapping[str, float] | None = None,
    pack: Callable[..., Any] | None = None,
    unpack: Callable[[Any], Any] | None = None,
    policy_server: bool = False,
    version: str | int = "",
    covers: Sequence[Any] | Mapping[str, Sequence[Any]] = (),
    together: Together | ByTogether | None = None,
) -> Any:
    """Register a function as a kind of task. It can still be called as an ordinary function.

    Robot and server load the same module. If the source of the function, of its setup, of its pack or unpack
    or of its dataclasses differs between them, the task stays onboard.
    `covers`: functions, classes and paths of files that count too, relative to the file of the function; with
    variants it may be a dictionary by site. `version`: a text or whole number that counts too.
    If `size` returns several numbers, the predictor `least-squares` uses all of them, and every other one
    uses the first; `parts` predicts from the work instead if the kind tells it (by the first number too).

    `variants`: the function of each site that does not run the decorated one; None: this computer does not
    have it. `quality`: how good the answers of each site are, from 0 to 1. With variants, `setup` may be a
    dictionary by site too.

    With `policy_server`, policy servers may answer too: the function takes one observation and returns an
    action, and no source is compared. `together`: what a server calls for several requests at once, of
    `cloud` or by site if there are variants.
    """
    if not isinstance(name, str) or len(name) > NAME_LENGTH_MAX or not name.isidentifier():
        raise ConfigError(f"task name {name!r} is not an identifier of at most {NAME_LENGTH_MAX} characters")
    check_types(name, types)

    def register(function: F) -> F:
        found = variants_of(
            name, function, variants=variants, quality=quality, setup=setup, policy_server=policy_server
        )
        own: Any = found[CLOUD].setup if found else setup
        covered = covers_by_site(name, function, covers=covers, sites=found)
        shared, joint = () if isinstance(covers, Mapping) else covers, by_site(name, together, found)
        kind = _checked(
            Kind(
                name, function, size, duplicate,
                types=tuple(types), warm=warm, work=work, setup=own,
                pack=pack, unpack=unpack, policy_server=policy_server,
                together=None if found else joint.get(CLOUD),
                covers=covers_of(name, function, version=version, covers=shared),
            )
        )  # fmt: skip
        _add(_with_variants(kind, found, covered, joint) if found else kind)
        return function

    return register


def first_number(size: Size) -> float:
    """The number of a size, or the first one of several."""
    return size[0] if isinstance(size, tuple) else size


def kind_of(function: Callable[..., Any]) -> Kind:
    """The kind of this function. UnknownTask if the function is not registered."""
    for kind in _kinds.values():
        if kind.function is function:
            return kind
    raise UnknownTask(f"{getattr(function, '__qualname__', function)} is not a task; decorate it with @task")


def kind_named(name: str) -> Kind:
    """What a server runs for a request with this name."""
    try:
        return _on_servers[name]
    except KeyError:
        known = ", ".join(sorted(_on_servers)) or "none"
        raise UnknownTask(f"no task named {name!r}; known: {known}") from None


def find_kind(name: str) -> Kind | None:
    return _on_servers.get(name)


def hashes() -> dict[str, str]:
    """What a `hello` says: the hash of each task, and of each variant that servers run."""
    return {one.name: one.fingerprint for kind in kinds() for one in (kind, *kind.on_servers())}


def kinds() -> tuple[Kind, ...]:
    return tuple(_kinds.values())


def _checked(kind: Kind) -> Kind:
    """The kind with what its functions say of it. ConfigError unless they can make a task."""
    name, function, setup = kind.name, kind.function, kind.setup
    check_ordinary(name, function=function, size=kind.size, setup=setup, work=kind.work, warm=kind.warm)
    check_packing(name, kind.pack, kind.unpack)
    parameters = given_to(name, function, setup).parameters.values()
    check_parameters(name, parameters)
    fixed = all(parameter.kind != parameter.VAR_POSITIONAL for parameter in parameters)
    count = len(parameters) if fixed else None
    if kind.policy_server and (count != 1 or kind.pack is not None):
        needs = "a function of one argument, the observation, and no pack="
        raise ConfigError(f"task {name}: policy_server=True needs {needs}")
    packing = (kind.pack, kind.unpack, *(kind.together.sources if kind.together else ()))
    own_hash = source_hash(function, setup, kind.types, packing, covers=kind.covers)
    return replace(kind, positional=count, source_hash=own_hash)


def _add(kind: Kind) -> None:
    known = _kinds.get(kind.name)
    if known is not None:
        _check_same(known, kind)
    names = sum(1 + len(one.variants) for one in _kinds.values() if one is not known)
    if names + 1 + len(kind.variants) > KINDS_MAX:
        allowed = f"a process has at most {KINDS_MAX} tasks, and each variant counts as one more"
        raise ConfigError(f"task {kind.name}: {allowed}")
    _kinds[kind.name] = kind
    _on_servers.update((one.name, one) for one in kind.on_servers())


def _with_variants(
    kind: Kind, found: Mapping[str, Variant], covered: Mapping[str, Covers], joint: ByTogether
) -> Kind:
    """The kind with a kind for each site, named TASK@SITE."""
    name, given = kind.name, kind.signature()
    if kind.work is not None:
        raise ConfigError(f"task {name}: work= cannot be used with variants=, which may do different work")
    packing, made = (kind.pack, kind.unpack), {}
    for site, one in found.items():
        function: Callable[..., Any] = elsewhere
        own_hash = ""
        if one.function is not None:
            function = one.function
            check_ordinary(name, variant=function, setup=one.setup)
            check_variant(name, site, function, setup=one.setup, given=given)
            parts = (*packing, *(joint[site].sources if site in joint else ()))
            own_hash = source_hash(function, one.setup, kind.types, parts, covers=covered[site])
        made[site] = replace(
            kind, name=f"{name}{AT}{site}", function=function, setup=one.setup, source_hash=own_hash,
            quality=one.quality, covers=covered[site], together=joint.get(site),
        )  # fmt: skip
        if len(made[site].name) > NAME_LENGTH_MAX:
            raise ConfigError(f"task {name}: {made[site].name!r} has over {NAME_LENGTH_MAX} characters")
    shared = contract_hash(given, kind.types, packing, covers=kind.covers)
    return replace(kind, source_hash=shared, variants=made)


def _check_same(known: Kind, kind: Kind) -> None:
    """ConfigError unless both are one function, whose module was loaded again or is also the script."""
    first, second = known.function, kind.function
    if _file(first) != _file(second) or name_of(first) != name_of(second):
        by = f"by {first.__module__}.{name_of(first)} and by {second.__module__}.{name_of(second)}"
    elif _sources(known) != _sources(kind):
        by = "with different source"
    else:
        return
    raise ConfigError(f"task {kind.name} is registered twice, {by}; rename one of them")


def _sources(kind: Kind) -> list[str]:
    return [kind.source_hash, *(one.source_hash for one in kind.variants.values())]


def _file(function: Callable[..., Any]) -> str:
    module = function.__module__
    return getattr(sys.modules.get(module), "__file__", None) or module
