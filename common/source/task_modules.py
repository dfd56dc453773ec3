"""Loads the modules that register tasks."""

import importlib
from collections.abc import Iterable

from offboard.common.errors import ConfigError, describe


def load_modules(names: Iterable[str]) -> None:
    """Import the modules that register tasks. ConfigError names a module that cannot be imported."""
    for name in names:
        meant = _meant(name)
        if meant != name:
            raise ConfigError(f"task module {name!r} is not the name of a module; did you mean {meant!r}?")
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:
            where = "; it is looked for in this folder and on PYTHONPATH"
            if name.startswith("examples."):
                where = "; examples/ is only in a checkout: start the command in the folder of the checkout"
            if not isinstance(error, ModuleNotFoundError) or not f"{name}.".startswith(f"{error.name}."):
                where = ""  # the module is there, but one that it imports is not, or it raises
            raise ConfigError(f"task module {name!r} cannot be imported: {describe(error)}{where}") from error


def _meant(name: str) -> str:
    """The module that a file, or MODULE:FUNCTION, stands for; the same name if it is that of a module."""
    file = name.partition(":")[0].removesuffix(".py")
    parts = [part for part in file.split("/") if part.strip(".")]
    if not parts:
        return name
    return parts[-1] if file.startswith(("/", "..")) else ".".join(parts)
