"""Comparing the tasks of a robot with those of a server."""

import pytest

from offboard.common.empty_task import EMPTY
from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind
from offboard.robot_client.check.network import StepFailed
from offboard.robot_client.check.task_comparison import PLANNER, compare, load_kinds


def kind(name: str, source_hash: str) -> Kind:
    return Kind(name, abs, float, source_hash=source_hash)


def test_equal_sources_pass() -> None:
    """The text names each task that is the same on both sides."""
    tasks = [kind("add", "a1"), kind("echo", "e1")]
    said = compare(tasks, {"add": "a1", "echo": "e1", "more": "m"}, chosen=True)
    assert "the same on both sides: add, echo; not compared: constants, " in said


def test_without_tasks_there_is_nothing_to_compare() -> None:
    """The text says how to name tasks."""
    assert compare([], {"add": "a1"}, chosen=False) == "none to compare; name modules with --tasks"


def test_a_task_that_nobody_chose_may_be_missing() -> None:
    """The planner is compared by default, but a server without it is not at fault."""
    said = compare([kind("plan_path", "p")], {"echo": "e", EMPTY: "x"}, chosen=False)
    assert said == "not compared; the server has echo; name the modules of your tasks with --tasks"


@pytest.mark.parametrize(
    ("here", "there", "said"),
    [
        ("a1", {"echo": "e", EMPTY: "x"}, "the server has no task add; it has echo; remedy: "),
        ("a1", {EMPTY: "x"}, "the server has no task add; it has none; remedy: "),
        (
            "0123456789",
            {"add": "9876543210"},
            "add differs: its source is 01234567 here, 98765432 on the server",
        ),
        ("", {"add": ""}, "its source is not readable here, not readable on the server"),
    ],
)
def test_a_difference_fails_with_a_remedy(here: str, there: dict[str, str], said: str) -> None:
    """A task is missing, its source differs, or its source cannot be read."""
    with pytest.raises(StepFailed) as caught:
        compare([kind("add", here)], there, chosen=True)
    assert said in str(caught.value)
    assert "; remedy: " in str(caught.value)


def test_without_modules_the_planner_is_loaded() -> None:
    """Its only task is plan_path."""
    assert [one.name for one in load_kinds([])] == ["plan_path"]
    assert [one.name for one in load_kinds([PLANNER])] == ["plan_path"]


def test_a_module_without_tasks_is_refused() -> None:
    """The error names the module."""
    with pytest.raises(ConfigError, match="--tasks: json registers no task"):
        load_kinds(["json"])
