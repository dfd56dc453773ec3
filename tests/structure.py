"""Measures the shape of a checkout: modules, sizes, folders, names, constants, flags.

`python -m tests.structure [FOLDER ..]` prints a column for each checkout. `test_structure.py` has the limits.
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

PACKAGES = ("common", "robot_client", "cloud_server", "loadgen", "offboard")
FUNCTION_LINES_MAX = 60
BRANCHES_MAX = 12
PARAMETERS_MAX = 8
POSITIONAL_MAX = 4
COMMANDS = {
    "robot-client": ("robot_client",),
    "robot-client check": ("robot_client", "check"),
    "robot-client ros2": ("robot_client", "ros2"),
    "cloud-server": ("cloud_server",),
    "loadgen drive": ("loadgen", "drive"),
    "loadgen call": ("loadgen", "call"),
    "loadgen wan": ("loadgen", "wan"),
    "loadgen compare": ("loadgen", "compare"),
}

Function = ast.FunctionDef | ast.AsyncFunctionDef
ANY_NUMBER = {"print", "max", "min", "zip", "hypot", "debug", "info", "warning", "error", "exception"}
BRANCHES = (
    ast.If,
    ast.For,
    ast.AsyncFor,
    ast.While,
    ast.ExceptHandler,
    ast.IfExp,
    ast.match_case,
)


@dataclass(frozen=True)
class Module:
    """One source file of the packages."""

    path: Path  # from the root of the checkout
    lines: int
    tree: ast.Module

    def functions(self) -> Iterator[Function]:
        for node in ast.walk(self.tree):
            if isinstance(node, Function):
                yield node

    def where(self, node: ast.expr | Function) -> str:
        return f"{self.path.as_posix()}:{node.lineno}"


def modules(root: Path) -> list[Module]:
    """Every module of the packages, in order of their paths."""
    found = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            text = path.read_text()
            found.append(Module(path.relative_to(root), text.count("\n"), ast.parse(text)))
    return found


def is_kernel(function: Function) -> bool:
    """Whether numba compiles the function: then it may be long."""
    return any("kernel" in ast.unparse(one) for one in function.decorator_list)


def long_functions(found: list[Module]) -> list[str]:
    """Functions over FUNCTION_LINES_MAX lines, compiled kernels left out."""
    return [
        f"{one.where(node)} {node.name}"
        for one in found
        for node in one.functions()
        if (node.end_lineno or 0) - node.lineno + 1 > FUNCTION_LINES_MAX and not is_kernel(node)
    ]


def branched_functions(found: list[Module]) -> list[str]:
    """Functions with more than BRANCHES_MAX branches, compiled kernels left out."""
    return [
        f"{one.where(node)} {node.name}"
        for one in found
        for node in one.functions()
        if sum(isinstance(inner, BRANCHES) for inner in ast.walk(node)) > BRANCHES_MAX and not is_kernel(node)
    ]


def wide_constructors(found: list[Module]) -> list[str]:
    """`__init__` with more than PARAMETERS_MAX parameters, `self` left out."""
    return [
        f"{one.where(node)} {node.name}"
        for one in found
        for node in one.functions()
        if node.name == "__init__" and len(node.args.args + node.args.kwonlyargs) - 1 > PARAMETERS_MAX
    ]


def positional_calls(found: list[Module]) -> list[str]:
    """Calls with more than POSITIONAL_MAX positional arguments outside compiled kernels.

    Python's own functions that take any number do not count, nor do calls of kernels, which take no keywords.
    """
    kernels = {node.name for one in found for node in one.functions() if is_kernel(node)}
    calls = []
    for one in found:
        compiled = {id(inner) for node in one.functions() if is_kernel(node) for inner in ast.walk(node)}
        for node in ast.walk(one.tree):
            if not isinstance(node, ast.Call) or id(node) in compiled or len(node.args) <= POSITIONAL_MAX:
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name not in kernels | ANY_NUMBER:
                calls.append(f"{one.where(node)} {name}")
    return calls


def numeric_constants(found: list[Module]) -> int:
    """Names in capitals that are bound to a number outside functions."""
    count = 0
    for one in found:
        bodies = [
            one.tree.body,
            *(node.body for node in ast.walk(one.tree) if isinstance(node, ast.ClassDef)),
        ]
        for statement in (statement for body in bodies for statement in body):
            targets = getattr(statement, "targets", [getattr(statement, "target", None)])
            value = getattr(statement, "value", None)
            if not isinstance(statement, ast.Assign | ast.AnnAssign) or value is None:
                continue
            names = [name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            if any(re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name.id) for name in names) and _is_number(value):
                count += len(names)
    return count


def _is_number(value: ast.expr) -> bool:
    """A number, arithmetic on numbers, or a tuple of them."""
    parts = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Tuple, ast.Load)
    inner = list(ast.walk(value))
    return all(isinstance(one, parts) for one in inner) and all(
        isinstance(one.value, int | float) and not isinstance(one.value, bool)
        for one in inner
        if isinstance(one, ast.Constant)
    )


def repeated_names(found: list[Module]) -> list[str]:
    """File names that occur twice in one package, `__init__` and `__main__` left out."""
    counts = Counter((one.path.parts[0], one.path.name) for one in found)
    return [
        f"{package}: {name}" for (package, name), count in counts.items() if count > 1 and "__" not in name
    ]


def files_by_folder(found: list[Module]) -> Counter[str]:
    return Counter(one.path.parent.as_posix() for one in found)


def shown_flags(root: Path, command: tuple[str, ...]) -> int | None:
    """Flags that `--help` of a command shows; None if the checkout has no such command."""
    module = f"offboard.{command[0]}" if (root / "offboard").is_dir() else command[0]
    said = subprocess.run(
        [sys.executable, "-m", module, *command[1:], "--help"],
        cwd=root,
        env={"PYTHONPATH": str(root), "COLUMNS": "100"},
        capture_output=True,
        text=True,
        check=False,
    )
    if said.returncode:
        return None
    shown = set(re.findall(r"^\s+(?:-\w, )?(--[a-z][a-z-]*)", said.stdout, re.MULTILINE))
    return len(shown - {"--help", "--help-all", "--version"})


def glossary_entries(root: Path) -> int:
    """Rows of the glossary's table."""
    lines = (root / "docs/glossary.md").read_text().splitlines()
    return sum(line.startswith("|") for line in lines) - 2  # heading and rule


def figures(root: Path) -> dict[str, str]:
    """Everything that is measured of a checkout, by what it is."""
    found = modules(root)
    folders = files_by_folder(found)
    largest = max(found, key=lambda one: one.lines)
    flags = {name: shown_flags(root, command) for name, command in COMMANDS.items()}
    return {
        "modules": str(len(found)),
        "lines": str(sum(one.lines for one in found)),
        "files per folder": ", ".join(f"{name} {count}" for name, count in sorted(folders.items())),
        "most files in a folder": "{} {}".format(*max(folders.items(), key=lambda item: item[1])),
        "file names twice in a package": str(len(repeated_names(found))),
        "median file, lines": f"{median(one.lines for one in found if one.lines > 1):.0f}",
        "largest file, lines": f"{largest.lines} ({largest.path.as_posix()})",
        f"functions over {FUNCTION_LINES_MAX} lines": str(len(long_functions(found))),
        f"functions over {BRANCHES_MAX} branches": str(len(branched_functions(found))),
        f"constructors over {PARAMETERS_MAX} parameters": str(len(wide_constructors(found))),
        f"calls over {POSITIONAL_MAX} positional arguments": str(len(positional_calls(found))),
        "numeric constants": str(numeric_constants(found)),
        "flags in --help": ", ".join(f"{name} {count}" for name, count in flags.items() if count is not None),
        "glossary entries": str(glossary_entries(root)),
    }


if __name__ == "__main__":
    columns = [figures(Path(name).resolve()) for name in sys.argv[1:] or ["."]]
    print(f"| | {' | '.join(sys.argv[1:] or ['here'])} |")
    print("| --- |" + " --- |" * len(columns))
    for what in columns[0]:
        print(f"| {what} | {' | '.join(column[what] for column in columns)} |")
