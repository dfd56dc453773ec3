"""The numbers that were set by hand where a robot decides: few, and each with its reason."""

from pathlib import Path

import pytest

from tests.constants import constants, constants_in

ROOT = Path(__file__).parents[2]
CONSTANTS_MAX = 63  # 17 of them in streams


def test_there_are_few_constants() -> None:
    """Learning, predictors, policies, heartbeat and streams have at most CONSTANTS_MAX; all are printed."""
    found = constants(ROOT)
    print(*found, sep="\n")
    assert len(found) <= CONSTANTS_MAX


def test_each_constant_has_a_reason() -> None:
    """A comment or a docstring says what the number is for, or why it is this one."""
    assert [str(one) for one in constants(ROOT) if not one.reason] == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("A = 1  # why", [("A", "1", "why")]),
        ("# why\n# it is\nA_B: float = 2 * -3.5", [("A_B", "2 * -3.5", "why it is")]),
        ('A = 1\n"""Why."""', [("A", "1", "Why.")]),
        ("class C:\n    A = 1", [("A", "1", "")]),
        ("A, _B = 1, 2 / 3  # both", [("A", "1", "both"), ("_B", "2 / 3", "both")]),
        ("A = (\n    0.5  # why\n)", [("A", "0.5", "why")]),
        ("A = B = 4  # why", [("A", "4", "why"), ("B", "4", "why")]),
        ("A = 3 * B\nC = 1 - math.sqrt(2)", [("A", "3 * B", ""), ("C", "1 - math.sqrt(2)", "")]),
        ("A = True\nB = 'x'\nC = D\nE = f()\nF = None\na = 5\ndef f():\n    A = 1", []),
    ],
)
def test_a_number_is_found_with_its_reason(text: str, found: list[tuple[str, str, str]]) -> None:
    """At the level of a module or a class, with arithmetic; not within functions, and no other values."""
    assert [(one.name, one.value, one.reason) for one in constants_in(text, "a.py")] == found
