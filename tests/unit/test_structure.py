"""The limits of size and shape that keep the code readable."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import structure

ROOT = Path(__file__).parents[2]
MODULES = structure.modules(ROOT)
FOLDER_FILES_MAX = {"common": 17, "cloud_server": 15}
FILES_MAX = 14
MODULE_LINES_MAX = 400
TEST_LINES_MAX = 400
ROBOT_LINES_MAX = 13_200
GLOSSARY_MAX = 60
FLAGS_MAX = 16


@pytest.mark.parametrize(
    "offenders",
    [
        structure.long_functions,
        structure.branched_functions,
        structure.wide_constructors,
        structure.positional_calls,
        structure.repeated_names,
    ],
)
def test_no_limit_is_broken(offenders: Callable[[list[structure.Module]], list[str]]) -> None:
    """There is no long or branched function, wide constructor, positional call or repeated file name."""
    assert offenders(MODULES) == []


def test_folders_hold_few_files() -> None:
    """No folder of the packages holds more files than a reader can take in."""
    for folder, count in structure.files_by_folder(MODULES).items():
        assert count <= FOLDER_FILES_MAX.get(folder, FILES_MAX), folder


def test_files_are_short() -> None:
    """No source file and no test file has more than 400 lines."""
    long = [one.path.as_posix() for one in MODULES if one.lines > MODULE_LINES_MAX]
    tests = (ROOT / "tests").rglob("test_*.py")
    long += [path.name for path in tests if len(path.read_text().splitlines()) > TEST_LINES_MAX]
    assert long == []


def test_what_a_robot_installs_is_small() -> None:
    """`robot_client` has at most ROBOT_LINES_MAX lines."""
    assert sum(one.lines for one in MODULES if one.path.parts[0] == "robot_client") <= ROBOT_LINES_MAX


def test_the_glossary_is_short() -> None:
    """A new noun is worth a glossary entry only while there are few."""
    assert structure.glossary_entries(ROOT) <= GLOSSARY_MAX


@pytest.mark.parametrize("command", structure.COMMANDS)
def test_help_shows_few_flags(command: str) -> None:
    """`--help` of a command shows at most 16 flags."""
    shown = structure.shown_flags(ROOT, structure.COMMANDS[command])
    assert shown is not None
    assert shown <= FLAGS_MAX
