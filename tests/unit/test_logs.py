"""What a log line says, and how it is written."""

import ast
import json
import logging
import sys
from pathlib import Path

import pytest

from offboard.common.logs import TASK, JsonLines

ROOT = Path(__file__).parents[2]
PACKAGES = ("common", "robot_client", "cloud_server", "loadgen", "offboard")
SERIOUS = ("log.warning", "log.error", "log.exception")


def test_a_json_line_has_the_fields_of_a_record() -> None:
    """Time in UTC, level, logger, message and task; a line break in the message stays in its string."""
    record = logging.makeLogRecord(
        {"name": "offboard.x", "levelno": 30, "levelname": "WARNING", "msg": "a %s\nb", "args": ("c",)}
    )
    record.created = 1.5
    assert json.loads(JsonLines().format(record)) == {
        "time": "1970-01-01T00:00:01.500+00:00",
        "level": "warning",
        "logger": "offboard.x",
        "message": "a c\nb",
    }
    setattr(record, TASK, {"i": 3})
    line = JsonLines().format(record)
    assert "\n" not in line
    assert json.loads(line)["task"] == {"i": 3}


def test_a_json_line_holds_the_traceback() -> None:
    """The traceback is a string of its own, so the line stays one line."""
    try:
        raise ValueError("bad")
    except ValueError:
        record = logging.makeLogRecord({"msg": "failed", "exc_info": sys.exc_info()})
    assert json.loads(JsonLines().format(record))["traceback"].endswith("ValueError: bad")


@pytest.mark.parametrize("package", PACKAGES)
def test_each_warning_says_what_to_do(package: str) -> None:
    """Each function that logs warnings and errors holds a remedy for each of them."""
    silent = []
    for path in (ROOT / package).rglob("*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                strings = [one.value for one in ast.walk(function) if isinstance(one, ast.Constant)]
                remedies = sum("remedy: " in text for text in strings if isinstance(text, str))
                if remedies < sum(is_serious(one) for one in ast.walk(function)):
                    silent.append(f"{path.relative_to(ROOT)}:{function.lineno}: {function.name}")
    assert silent == []


def is_serious(node: ast.AST) -> bool:
    """Whether this is a call that logs a warning or an error."""
    if not isinstance(node, ast.Call):
        return False
    name, given = ast.unparse(node.func), map(ast.unparse, node.args)
    return name in SERIOUS or (name.endswith("._log") and "logging.WARNING" in given)
