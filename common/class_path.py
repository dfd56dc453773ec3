"""Finds a class that a user names by its path, such as the predictor or policy of a researcher.

What the class must offer is said where it is called.
"""

import importlib
from typing import Any

from offboard.common.errors import ConfigError, describe

MODULE_CLASS = "MODULE.CLASS"


def find_class(path: str, what: str) -> Any:
    """The class that MODULE.CLASS names; ConfigError, which says `what` it should be, if there is none."""
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ConfigError:  # such as a missing extra
        raise
    except (Exception, SystemExit) as error:
        why = f"module {module!r} cannot be imported: {describe(error)}"
        raise ConfigError(f"{what} {path!r}: {why}") from error
    if not callable(found):
        raise ConfigError(f"{what} {path!r}: module {module!r} has no class {name!r}")
    return found
