"""The `kernel` decorator: compiles a function with numba, without the interpreter lock, cached on disk.

Without numba every module still imports; calling a kernel then names the extra to install. There is no
slow fallback, because it would falsify every measured time.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar, cast

from offboard.common.errors import MissingExtra

F = TypeVar("F", bound=Callable[..., Any])

log = logging.getLogger(__name__)

try:
    import numba as _numba
except ImportError:
    numba: Any = None
else:
    numba = _numba


def kernel(function: F) -> F:
    """Compile `function` on its first call; numba's cache honours NUMBA_CACHE_DIR."""
    if numba is None:
        return cast(F, functools.wraps(function)(_missing))
    try:
        return cast(F, numba.njit(nogil=True, cache=True)(function))
    except RuntimeError as error:  # no folder to write the cache to, as in a read-only container
        log.warning("%s is compiled anew in every process: %s", function.__name__, error)
        return cast(F, numba.njit(nogil=True)(function))


def _missing(*_args: Any, **_kwargs: Any) -> NoReturn:
    raise MissingExtra("planning", "planning")
