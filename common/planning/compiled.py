"""The `kernel` decorator: compiles a function with numba, releases the interpreter lock, caches on disk.

Without numba every module can still be imported; calling a kernel raises an error that names the extra. There
is no slow fallback, because it would falsify every measured time.
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
    """Compile `function` at its first call. Set NUMBA_CACHE_DIR to choose the folder of numba's cache."""
    if numba is None:
        return cast(F, functools.wraps(function)(_missing))
    try:
        return cast(F, numba.njit(nogil=True, cache=True)(function))
    except RuntimeError as error:  # no folder to write the cache to, as in a read-only container
        text = "every process compiles %s anew: %s; remedy: set NUMBA_CACHE_DIR to a folder for the cache"
        log.warning(text, function.__name__, error)
        return cast(F, numba.njit(nogil=True)(function))


def _missing(*_args: Any, **_kwargs: Any) -> NoReturn:
    raise MissingExtra("planning", "planning")
