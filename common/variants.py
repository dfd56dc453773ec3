"""The functions of a task: what is allowed, what a caller gives them, and the variants of each site."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, NoReturn

from offboard.common.errors import ConfigError, UnknownTask

OPTIONS = ("deadline_s", "function", "observe", "timeout_s", "where")  # of a call, in this version or others
ONBOARD = "onboard"
CLOUD = "cloud"  # it stands for each server that has no variant of its own
AT = "@"  # between the task and the site in the name of a variant
IN_GROUP = "/"  # between the group of a site and its own name: planners/10.0.0.7
SITE_LENGTH_MAX = 32
# It runs its own model, and no function of the robot; the decorated function runs onboard.
QUALITY_OF_POLICY_SERVER = (
    'for a policy server write variants={"cloud": None}, quality={"onboard": 0.7, "cloud": 1.0} with your '
    'numbers; "cloud" stands for each server'
)


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


def given_to(name: str, function: Callable[..., Any], setup: object) -> inspect.Signature:
    """What a caller gives to this function of a task. ConfigError if it cannot take the result of a setup."""
    signature = inspect.signature(function)
    first = next(iter(signature.parameters.values()), None)
    takes_one = first is not None and first.kind in (first.POSITIONAL_ONLY, first.POSITIONAL_OR_KEYWORD)
    if setup is not None and not takes_one:
        raise ConfigError(f"task {name}: setup= needs a function whose first parameter takes its result")
    return without_state(signature, setup)


def check_variant(
    name: str, site: str, function: Callable[..., Any], *, setup: object, given: inspect.Signature
) -> None:
    """ConfigError unless a caller gives this variant of a task what the task itself is `given`."""
    try:
        own = given_to(name, function, setup)
    except (TypeError, ValueError) as error:  # many functions of C libraries have no signature
        raise ConfigError(f"task {name}: the variant of {site!r} has no signature: {error}") from error
    wanted, found = _shown(given), _shown(own)
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


@dataclass(frozen=True, slots=True)
class Variant:
    """What one site runs. `function`: None if this computer does not have it."""

    function: Callable[..., Any] | None
    setup: Callable[[], Any] | None
    quality: float


def group_of(site: str) -> str:
    """The group of equal servers that a site belongs to; a site without one is a group of its own."""
    return site.partition(IN_GROUP)[0]


def elsewhere(*_: object) -> NoReturn:
    """Stands for the function of a variant that this computer does not have."""
    raise UnknownTask("this computer does not have the function of this variant")


def variants_of(
    task: str,
    function: Callable[..., Any],
    *,
    variants: object,
    quality: object,
    setup: object,
    policy_server: bool,
) -> dict[str, Variant]:
    """The variant of each site by name, empty if the task has none; ConfigError if they do not fit together.

    A site without a function of its own runs the decorated `function`.
    """
    try:
        return _variants_of(task, function, variants=variants, quality=quality, setup=setup)
    except ConfigError as error:
        if not policy_server:
            raise
        raise ConfigError(f"{error}; {QUALITY_OF_POLICY_SERVER}") from None


def _variants_of(
    task: str, function: Callable[..., Any], *, variants: object, quality: object, setup: object
) -> dict[str, Variant]:
    if variants is None and quality is None:
        if isinstance(setup, Mapping):
            raise ConfigError(f"task {task}: setup= by site needs variants=")
        return {}
    functions, grades = _by_site(task, "variants", variants), _by_site(task, "quality", quality)
    for site in (ONBOARD, CLOUD, *functions):
        if site not in grades:
            needs = f"it needs {ONBOARD}, {CLOUD} and each site of variants="
            raise ConfigError(f"task {task}: quality= has no {site!r}; {needs}")
    for site, grade in grades.items():
        _check_grade(task, site, grade, known=site in functions or site in (ONBOARD, CLOUD))
        if site in functions and functions[site] is not None and not callable(functions[site]):
            raise ConfigError(f"task {task}: variants= has {functions[site]!r:.80} for {site!r}, no function")
    setups = _setups(task, setup, grades)
    return {
        site: Variant(functions.get(site, function), setups[site], float(grade))
        for site, grade in grades.items()
    }


def _by_site(task: str, option: str, given: object) -> Mapping[str, Any]:
    if not isinstance(given, Mapping) or not given:
        needs = "a task with variants needs variants= and quality=, dictionaries by site"
        raise ConfigError(f"task {task}: {option}= is {given!r:.80}; {needs}")
    return given


def _check_grade(task: str, site: object, grade: object, *, known: bool) -> None:
    if not isinstance(site, str) or not 0 < len(site) <= SITE_LENGTH_MAX:
        allowed = f"the name of a site, 1 to {SITE_LENGTH_MAX} characters"
        raise ConfigError(f"task {task}: quality= names {site!r:.80}, which is not {allowed}")
    if not known:
        raise ConfigError(f"task {task}: quality= names {site!r}, which has no variant in variants=")
    if isinstance(grade, bool) or not isinstance(grade, Real) or not 0 <= float(grade) <= 1:
        raise ConfigError(f"task {task}: quality of {site!r} is {grade!r:.80}; it must be a number 0 to 1")


def _setups(task: str, setup: Any, sites: Mapping[str, Any]) -> Mapping[str, Any]:
    """The setup of each site: one for all, or one for each."""
    if not isinstance(setup, Mapping):
        return dict.fromkeys(sites, setup)
    if setup.keys() != sites.keys() or not all(map(callable, setup.values())):
        needs = ", ".join(map(str, sites))
        raise ConfigError(f"task {task}: setup= by site must have one function for each of {needs}")
    return setup
