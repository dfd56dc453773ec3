"""When the files that tasks cover are read: on a robot at the first use of a task, on a server at its start.

A robot need not have the files of the variants that servers run; what one file is like is in `covered_files`.
"""

from collections.abc import Callable, Iterator
from typing import Any

from offboard.common.source.covered_files import CoveredFiles
from offboard.common.tasks import Kind, kind_of, kinds
from offboard.common.variants import ONBOARD


def kind_in_use(function: Callable[..., Any]) -> Kind:
    """The kind of a function that a robot uses now: a thread begins to read the files that it covers.

    UnknownTask if the function is not registered, ConfigError if a file is missing.
    """
    kind = kind_of(function)
    if kind.variants or kind.covers.files is not None:
        for files, needed in _on_robot(kind):
            files.begin(needed=needed)
    return kind


def is_reading(kind: Kind) -> bool:
    """Whether files that the kind or one of its variants covers are being read."""
    return any(files.reading for files, _ in _on_robot(kind))


def read_files_of_robot(kind: Kind) -> None:
    """Read the files that the kind covers, and wait until that is done. ConfigError if one is missing."""
    for files, needed in _on_robot(kind):
        files.read(needed=needed)


def read_files_of_server() -> None:
    """Read the files that all tasks of a server cover. ConfigError if one is missing."""
    for kind in kinds():
        for one in (kind, *kind.on_servers()):
            if one.covers.files is not None:
                one.covers.files.read()


def _on_robot(kind: Kind) -> Iterator[tuple[CoveredFiles, bool]]:
    """The files of the kind and of its variants, and whether a robot needs them."""
    if kind.covers.files is not None:
        yield kind.covers.files, True
    for site, one in kind.variants.items():
        if one.covers.files is not None and one.present:
            yield one.covers.files, site == ONBOARD
