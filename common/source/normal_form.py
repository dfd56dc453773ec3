"""The source of a function or class in a form in which comments, docstrings and formatting do not count.

The form is the same on every Python from 3.10 on; only the standard library is imported, so that a test can
load this file with each of them. `source_hash` makes a hash of it.
"""

import ast
import functools
import inspect
import linecache
import warnings
from collections.abc import Iterator
from typing import Any

# `ctx` follows from the place of a name, `kind` is the u of u"text"; neither changes what the code does.
LEFT_OUT = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
NO_FILE = "<string>"  # of exec and `python -c`, whose source Python 3.13 keeps under this name


def normal_form(of: Any) -> str:
    """The normal form of a function or class; empty if its source cannot be read.

    A partial counts as its function. A lambda counts with the whole statement that holds it.
    """
    try:
        of = function_of(of)
        tree = _tree(_text(of))
    except (OSError, TypeError, SyntaxError, ValueError, RecursionError, MemoryError):
        return ""
    if inspect.isclass(of):
        found = [one for name, one in _definitions(tree) if name == of.__qualname__]
    elif (code := of.__code__).co_name == "<lambda>":
        found = [one for one in _statements(tree) if _has_lambda(one, code.co_firstlineno)]
    else:
        qualified = getattr(code, "co_qualname", of.__qualname__)  # Python 3.10 has no co_qualname
        found = [one for name, one in _definitions(tree) if name == qualified]
    return "\n".join(map(_form, found))


def function_of(given: Any) -> Any:
    """The function within decorators that say what they wrap, and within partials."""
    given = inspect.unwrap(given)
    while isinstance(given, functools.partial):
        given = inspect.unwrap(given.func)
    return given


def _text(of: Any) -> str:
    """The whole file of a function or class. OSError or TypeError if it has none."""
    file = inspect.getsourcefile(of) or inspect.getfile(of)
    if file == NO_FILE:
        raise OSError("code without a file")
    linecache.checkcache(file)
    module = inspect.getmodule(of, file)
    return "".join(linecache.getlines(file, None if module is None else vars(module)))


@functools.lru_cache(1)  # the functions of a task are mostly in one file
def _tree(text: str) -> ast.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the import of the file has warned already
        return ast.parse(text)


def _definitions(node: ast.AST, within: str = "") -> Iterator[tuple[str, ast.AST]]:
    """Each function and class with its qualified name."""
    for child in _inner_statements(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield within + child.name, child
            yield from _definitions(child, f"{within}{child.name}.<locals>.")
        elif isinstance(child, ast.ClassDef):
            yield within + child.name, child
            yield from _definitions(child, f"{within}{child.name}.")
        else:
            yield from _definitions(child, within)


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    for child in _inner_statements(node):
        yield child
        yield from _statements(child)


def _inner_statements(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield child


def _has_lambda(statement: ast.AST, line: int) -> bool:
    """Whether a lambda begins in this line of the statement; statements within the statement do not count."""
    inner = set(map(id, _inner_statements(statement)))
    todo = [one for one in ast.iter_child_nodes(statement) if id(one) not in inner]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Lambda) and node.lineno == line:
            return True
        todo += ast.iter_child_nodes(node)
    return False


def _form(node: ast.AST) -> str:
    """The tree in one line. `ast.dump` will not do: what it leaves out differs between versions of Python."""
    written: list[str] = []
    todo: list[ast.AST | str] = [node]
    while todo:  # no recursion: a long sum is a deep tree
        one = todo.pop()
        if isinstance(one, str):
            written.append(one)
        else:
            todo += reversed(_pieces(one))
    return "".join(written)


def _pieces(node: ast.AST) -> list[ast.AST | str]:
    pieces: list[ast.AST | str] = [type(node).__name__, "("]
    for name, value in ast.iter_fields(node):
        if isinstance(value, list):
            items = _without_texts(value)
            if isinstance(node, ast.JoinedStr):
                items = _joined(value)
            if items:
                pieces += [name, "=["]
                for one in items:
                    pieces += [one if isinstance(one, ast.AST) else _word(one), ","]
                pieces.append("]")
        elif isinstance(node, ast.Constant) and name == "value":
            pieces.append(_word(value))
        elif value is not None and name not in LEFT_OUT and not (name == "format_spec" and _is_empty(value)):
            pieces += [name, "=", value if isinstance(value, ast.AST) else _word(value), ","]
    return [*pieces, ")"]


def _without_texts(items: list[Any]) -> list[Any]:
    """The items without docstrings and other statements that are only a text."""
    kept = [one for one in items if not (isinstance(one, ast.Expr) and _is_text(one.value))]
    return kept if kept or not items else [ast.Pass()]


def _joined(parts: list[Any]) -> list[Any]:
    """The parts of an f-string; versions of Python split the text between its fields in other ways."""
    joined: list[Any] = []
    for part in parts:
        if _is_text(part) and joined and _is_text(joined[-1]):
            joined[-1] = ast.Constant(joined[-1].value + part.value)
        elif not (_is_text(part) and not part.value):
            joined.append(part)
    return joined


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_empty(value: object) -> bool:
    """Whether this is the format of f"{x:}", which formats as f"{x}" does."""
    return isinstance(value, ast.JoinedStr) and not _joined(value.values)


def _word(value: object) -> str:
    """A constant or name: which characters `repr` escapes, and how long a number may be, can differ."""
    if isinstance(value, int) and not isinstance(value, bool):
        return hex(value)
    return ascii(value)
