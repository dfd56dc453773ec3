"""Several requests that run in one call of a function on a server: `@task(.., together=Together(..))`."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from offboard.common.errors import BadValue, ConfigError, describe, is_interrupt
from offboard.common.variants import CLOUD, check_ordinary

AT_MOST_MAX = 256
WAIT_S_MAX = 10.0
KEY_LENGTH_MAX = 128  # of the text that a request carries


@dataclass(frozen=True, slots=True)
class Together:
    """How a server runs several requests of one task in one call.

    function: gets a list with the arguments of each request (a tuple, if the task takes several), after the
        state if the task has a setup. It returns the list of results, in the same order.
    at_most: requests of one run.
    wait_s: the longest wait for more requests, in seconds; how long a server really waits is learned.
    key: maps the arguments of a request to a value; only requests with equal values run together. It is
        compared as text (`repr`), of at most 128 characters.
    """

    function: Callable[..., Any]
    at_most: int = 8
    wait_s: float = 0.01
    key: Callable[..., object] | None = None

    def __post_init__(self) -> None:
        if not callable(self.function) or not (self.key is None or callable(self.key)):
            raise ConfigError(f"together: {self.function!r:.80} and {self.key!r:.80} must be functions")
        if not (_is_number(self.at_most, Integral) and 2 <= self.at_most <= AT_MOST_MAX):
            raise ConfigError(f"together: at_most {self.at_most!r:.80} is not 2 to {AT_MOST_MAX}")
        if not (_is_number(self.wait_s, Real) and 0 <= self.wait_s <= WAIT_S_MAX):
            raise ConfigError(f"together: wait_s {self.wait_s!r:.80} is not 0 to {WAIT_S_MAX:g} seconds")

    @property
    def sources(self) -> tuple[Callable[..., Any] | None, ...]:
        """What counts as source of the task."""
        return self.function, self.key

    def key_of(self, args: Iterable[Any]) -> str:
        """The text that must be equal for requests to run together. BadValue if `key` raises."""
        if self.key is None:
            return ""
        try:
            return repr(self.key(*args))[:KEY_LENGTH_MAX]
        except BaseException as error:  # the function is the user's own
            if is_interrupt(error):
                raise
            raise BadValue(f"key of together: {describe(error)}") from error


def _is_number(value: object, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def by_site(task: str, together: object, sites: Iterable[str]) -> dict[str, Together]:
    """The `together` of each site that has one. Without sites, that of the task has the name `cloud`.

    With variants, one that is no dictionary by site belongs to `cloud`. ConfigError for anything else.
    """
    if together is None:
        return {}
    given = together if isinstance(together, Mapping) else {CLOUD: together}
    known, found = [*sites] or [CLOUD], {}
    for site, one in given.items():
        if not isinstance(one, Together) or site not in known:
            allowed = f"it must be Together(..), or a dictionary of them by site: {', '.join(known)}"
            raise ConfigError(f"task {task}: together= has {one!r:.80} for {site!r:.80}; {allowed}")
        check_ordinary(task, together=one.function, key=one.key)
        found[site] = one
    return found
