"""The variants of a task: the function of each site, and how good its answers are.

`tasks` makes a kind of each of them; what lost quality is worth is decided in `robot_client`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, NoReturn

from offboard.common.errors import ConfigError, UnknownTask

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
        _check_site(task, site, known=site in functions or site in (ONBOARD, CLOUD))
        _check_quality(task, site, grade)
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


def _check_site(task: str, site: object, *, known: bool) -> None:
    if not isinstance(site, str) or not 0 < len(site) <= SITE_LENGTH_MAX:
        allowed = f"the name of a site, 1 to {SITE_LENGTH_MAX} characters"
        raise ConfigError(f"task {task}: quality= names {site!r:.80}, which is not {allowed}")
    if not known:
        raise ConfigError(f"task {task}: quality= names {site!r}, which has no variant in variants=")


def _check_quality(task: str, site: str, grade: object) -> None:
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
