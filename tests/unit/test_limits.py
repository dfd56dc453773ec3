"""The table of limits in docs/limits.md says what the code does."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.limits import CONSTANTS, WITHOUT

PAGE = Path(__file__).parents[2] / "docs" / "limits.md"
UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "million": 1e6, "minutes": 60, "hours": 3600}
NUMBER = re.compile(rf"(\d[\d,]*(?:\.\d+)?)(?: ({'|'.join(UNITS)}))?\b")
NO_LIMIT = re.compile(r"`[^`]*`|exit code \d+|\b413\b")  # names, and what a program answers


def numbers(text: str) -> list[float]:
    """The numbers of a text, in bytes, seconds and pieces."""
    found = NUMBER.findall(NO_LIMIT.sub("", text).replace("twice", "2"))
    return [float(number.replace(",", "")) * UNITS.get(unit, 1) for number, unit in found]


def rows() -> Iterator[tuple[str, str]]:
    """Each row of the table: what is limited, and the rest."""
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if len(cells) == 3 and cells[1] not in ("", "---", "limit") and not cells[0].startswith("**"):
            yield cells[0], f"{cells[1]}; {cells[2]}"


ROWS = dict(rows())


def test_every_row_of_the_table_is_known() -> None:
    """It has constants, or a reason why it has none; and no row is there twice."""
    assert sorted(ROWS) == sorted(CONSTANTS | WITHOUT)
    assert len(ROWS) == len(list(rows()))
    assert not CONSTANTS.keys() & WITHOUT.keys()


@pytest.mark.parametrize("what", CONSTANTS)
def test_the_numbers_of_a_row_are_those_of_the_code(what: str) -> None:
    """All of them, in their order."""
    assert numbers(ROWS[what]) == [float(number) for number in CONSTANTS[what]], ROWS[what]
