"""Docstrings as the site shows them.

What follows `name:` at the start of a line becomes an item of a list. The help of a setting is its docstring.
A setting is made by `setting`, or by a partial of it, whose name ends with that word.
"""

import ast
import re
from typing import Any

import griffe

ITEM = re.compile(r"^(`?[a-z_]\w*`?(?:, `?[a-z_]\w*`?)*): ")


class Items(griffe.Extension):
    """Our docstrings explain parameters and fields line by line, without a markup of their own."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        value = obj.value if isinstance(obj, griffe.Attribute) else None
        if isinstance(value, griffe.ExprCall) and str(value.function).endswith("setting"):
            default, said, *_others = value.arguments
            obj.value = default
            if text := literal(str(said)):
                obj.docstring = griffe.Docstring(text, parent=obj)
        elif obj.docstring is not None:
            obj.docstring.value = with_items(obj.docstring.value)


def literal(code: str) -> str:
    """The text that this code is, if it is a plain string."""
    try:
        return str(ast.literal_eval(code))
    except (ValueError, SyntaxError):
        return ""


def with_items(text: str) -> str:
    lines: list[str] = []
    for line in text.splitlines():
        if found := ITEM.match(line):
            if (
                lines
                and not lines[-1].startswith("- ")
                and lines[-1].strip()
                and not lines[-1].startswith(" ")
            ):
                lines.append("")
            names = ", ".join(f"`{name.strip(' `')}`" for name in found[1].split(","))
            line = f"- {names}: {line[found.end() :]}"
        lines.append(line)
    return "\n".join(lines)
