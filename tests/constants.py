"""Lists the numbers that were set by hand where a robot decides, each with its reason.

`python -m tests.constants [FOLDER]` prints those of a checkout. `test_constants.py` has the limit.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PLACES = (
    "robot_client/learning",
    "robot_client/predictors",
    "robot_client/policies",
    "robot_client/sites/heartbeat.py",
    "robot_client/streams",
)
NAME = re.compile(r"_?[A-Z][A-Z0-9_]*")
NUMBERS = (ast.Constant, ast.Name, ast.BinOp, ast.UnaryOp, ast.Tuple, ast.operator, ast.unaryop, ast.Load)


@dataclass(frozen=True)
class Constant:
    """A name in capitals that is bound to a number; `reason` is its comment or docstring."""

    place: str
    name: str
    value: str
    reason: str

    def __str__(self) -> str:
        return f"{self.place} {self.name} = {self.value}  # {self.reason or 'NO REASON'}"


def constants(root: Path) -> list[Constant]:
    """The constants of all PLACES of a checkout, in the order of their files."""
    paths = [root / place for place in PLACES]
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    return [one for file in files for one in constants_in(file.read_text(), str(file.relative_to(root)))]


def constants_in(text: str, path: str) -> Iterator[Constant]:
    """The constants of one file, at the level of the module or of a class."""
    tree, comments = ast.parse(text), _comments(text)
    for scope in ast.walk(tree):
        if not isinstance(scope, ast.Module | ast.ClassDef):
            continue
        for statement, following in zip(scope.body, [*scope.body[1:], None], strict=True):
            for name, value in _numbers(statement):
                place = f"{path}:{statement.lineno}"
                yield Constant(place, name, value, _reason(statement, following, comments))


def _numbers(statement: ast.stmt) -> Iterator[tuple[str, str]]:
    """Names in capitals, each with the number that the statement binds to it."""
    if isinstance(statement, ast.AnnAssign):
        targets: list[ast.expr] = [statement.target]
    elif isinstance(statement, ast.Assign):
        targets = statement.targets
    else:
        return
    if statement.value is None:
        return
    for target in targets:
        values = [(target, statement.value)]
        if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
            values = list(zip(target.elts, statement.value.elts, strict=True))
        for name, value in values:
            if isinstance(name, ast.Name) and NAME.fullmatch(name.id) and _is_number(value):
                yield name.id, ast.unparse(value)


def _is_number(value: ast.expr) -> bool:
    """Whether this is a number, or arithmetic in which a number occurs."""
    inner = list(ast.walk(value))
    literals = [one.value for one in inner if isinstance(one, ast.Constant)]
    plain = all(isinstance(one, int | float) and not isinstance(one, bool) for one in literals)
    known = all(isinstance(one, NUMBERS) or _is_function(one) for one in inner)
    return bool(literals) and plain and known


def _is_function(node: ast.AST) -> bool:
    """Whether this is part of a call such as round(..) or math.sqrt(..)."""
    return isinstance(node, ast.Attribute) or (isinstance(node, ast.Call) and not node.keywords)


def _reason(statement: ast.stmt, following: ast.stmt | None, comments: dict[int, tuple[str, bool]]) -> str:
    """The comment in the lines of a statement, or above it; or the docstring below it."""
    last = statement.end_lineno or statement.lineno
    said = [comments[line][0] for line in range(statement.lineno, last + 1) if line in comments]
    first = statement.lineno
    while comments.get(first - 1, ("", False))[1]:
        first -= 1
    said = said or [comments[line][0] for line in range(first, statement.lineno)]
    if not said and isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        said = [str(following.value.value)]
    return " ".join(said)


def _comments(text: str) -> dict[int, tuple[str, bool]]:
    """The comment of each line, and whether it has the line for itself."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {
        one.start[0]: (one.string.lstrip("# "), one.line.lstrip().startswith("#"))
        for one in tokens
        if one.type == tokenize.COMMENT
    }


if __name__ == "__main__":
    found = constants(Path(sys.argv[1] if sys.argv[1:] else "."))
    print(*found, f"{len(found)} constants", sep="\n")
