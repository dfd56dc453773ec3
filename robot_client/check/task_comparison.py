"""Compares the tasks of this robot with those of a server, by name and by the hash of their source."""

import contextlib
from collections.abc import Mapping, Sequence

from offboard.common import VERSION as SOFTWARE
from offboard.common.empty_task import EMPTY
from offboard.common.errors import ConfigError
from offboard.common.source.comparison import (
    difference,
    not_compared,
    other_sources,
    read_files_of_robot,
    versions,
)
from offboard.common.source.task_modules import load_modules
from offboard.common.tasks import Kind, kinds
from offboard.common.variants import AT
from offboard.robot_client.check.network import StepFailed
from offboard.robot_client.sites.runner import CLOUD

COMPARED = "functions, setups, packing, dataclasses and what covers= names"
HASH_SHOWN = 8  # characters of a source hash
PLANNER = "offboard.common.planning.planner"


def load_kinds(modules: Sequence[str]) -> tuple[Kind, ...]:
    """The tasks of these modules; without modules those of the planner, if it is installed.

    The files that they cover are read.
    """
    if not modules:
        with contextlib.suppress(ConfigError):  # the extra `planning` is not installed
            return _registered_by([PLANNER])
        return ()
    found = _registered_by(modules)
    if not found:
        raise ConfigError(f"--tasks: {','.join(modules)} registers no task")
    for kind in found:
        read_files_of_robot(kind)
    return found


def compare(
    tasks: Sequence[Kind], there: Mapping[str, str], *, chosen: bool, software: str = SOFTWARE
) -> str:
    """What is the same on both sides; `there` holds the source hash of each task of the server.

    `software`: the version of Offboard there. A missing task is a failure only if the user has `chosen` the
    tasks to compare.
    """
    known = ", ".join(sorted(name for name in there if name != EMPTY and AT not in name)) or "none"
    for kind in tasks:
        module = kind.function.__module__
        if kind.name not in there:
            if not chosen:
                return f"not compared; the server has {known}; name the modules of your tasks with --tasks"
            raise StepFailed(
                f"the server has no task {kind.name}; it has {known}",
                f"start the server with --tasks {module}",
            )
        why = difference(kind, CLOUD, there, software)
        if why is None:
            continue
        if not kind.variants and other_sources({kind.name: kind.source_hash}, there):
            hashes = f"{_short(kind.source_hash)} here, {_short(there[kind.name])} on the server"
            what = "its source, with the code that it covers," if kind.covers.code else "its source"
            why = f"{kind.name} differs: {what} is {hashes}{versions(software)}"
        what = module if software == SOFTWARE else f"Offboard and of {module}"
        raise StepFailed(why, f"install the same version of {what} on both sides, and restart the server")
    if not tasks:
        return "none to compare; name modules with --tasks"
    names = ", ".join(kind.name for kind in tasks)
    return f"{COMPARED} are the same on both sides: {names}; not compared: {not_compared(tasks)}"


def _registered_by(modules: Sequence[str]) -> tuple[Kind, ...]:
    """The tasks that importing these modules registers, now or before."""
    before = kinds()
    load_modules(modules)
    return tuple(kind for kind in kinds() if kind not in before or kind.function.__module__ in modules)


def _short(source_hash: str) -> str:
    return source_hash[:HASH_SHOWN] or "not readable"
