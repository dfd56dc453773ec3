"""The code that a step runs: the product, and those benchmarks that its commands name, with what they import.

So a change of one benchmark leaves the figures of the others up to date.
"""

import ast
import shlex
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from benchmarks.figures.step import ROOT
from offboard.loadgen.play.machine import NOT_CODE, output_of

PACKAGE = "benchmarks"
PRODUCT = (
    ":(top)",
    *(f":(top,exclude){pattern}" for pattern in NOT_CODE),
    f":(top,exclude,glob){PACKAGE}/*.py",
)


def commit_of(commands: Sequence[str]) -> str | None:
    """The last commit that changed the code that these commands run; None if git does not tell."""
    files = [f":(top){path.relative_to(ROOT)}" for path in sorted(benchmarks_of(commands))]
    product, own = _last(PRODUCT), _last(tuple(files)) if files else None
    if product is None or own is None:
        return product
    return max(product, own, key=_place)


def benchmarks_of(commands: Iterable[str]) -> set[Path]:
    """The files of `benchmarks` that these commands name, and those that they import."""
    words = [word for command in commands for word in shlex.split(command)]
    named = [word for word in words if word.partition(".")[0] == PACKAGE]
    if PACKAGE in named:  # `python -m benchmarks TABLE`
        named += [f"{PACKAGE}.{word}" for word in words]
    found, left = set[Path](), [path for name in named for path in _files(name)]
    while left:
        path = left.pop()
        if path not in found:
            found.add(path)
            left += [one for name in _imports(path) for one in _files(name)]
    return found


@cache
def _imports(path: Path) -> frozenset[str]:
    """The modules of `benchmarks` that a file imports, anywhere in it or by a path in a string."""
    names = set[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names.update([node.module, *(f"{node.module}.{one.name}" for one in node.names)])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.update(word for word in node.value.split() if word.startswith(f"{PACKAGE}."))
    return frozenset(name for name in names if name.partition(".")[0] == PACKAGE)


def _files(name: str) -> list[Path]:
    """The file of a module, or of the module that a longer name is in."""
    at = ROOT / Path(*name.split(".")[:2])
    return [path for path in (at.with_suffix(".py"), at / "__main__.py") if path.is_file()]


@cache
def _last(paths: tuple[str, ...]) -> str | None:
    return output_of(("git", "log", "-1", "--format=%h", "--abbrev=12", "--", *paths))


@cache
def _place(commit: str) -> int:
    """The number of commits up to this one."""
    return int(output_of(("git", "rev-list", "--count", commit)) or 0)
