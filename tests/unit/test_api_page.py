"""docs/api.md lists every public name, and says where trace and Python use other names."""

from dataclasses import replace
from operator import attrgetter
from typing import Any

import pytest

import offboard
import offboard.testing
from docs.site.reference import GROUPS, OTHER_NAMES, PAGE, ROOT, page, paragraph
from offboard.robot_client.policies import Hedge, Outlook
from offboard.robot_client.policies.forecast import Quality
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.sites.runner import CLOUD, Condition
from tests.unit.test_trace import record

GROUPED = [name for names in GROUPS.values() for name in names]


def test_the_page_is_that_of_the_docstrings() -> None:
    """It is written by a program, and the code has not changed since."""
    assert (ROOT / PAGE).read_text(encoding="utf-8") == page(), "run `python -m docs.site.reference`"


def test_the_page_has_every_public_name() -> None:
    """Each name of `offboard` and of `offboard.testing` is in one group."""
    kit = [f"testing.{name}" for name in offboard.testing.__all__]
    assert sorted(GROUPED) == sorted([*offboard.__all__, *kit])


@pytest.mark.parametrize("name", [name for name in GROUPED if not name.startswith("_")])
def test_every_public_name_has_a_docstring(name: str) -> None:
    """A dataclass or named tuple without one would get its signature."""
    assert not paragraph(attrgetter(name)(offboard).__doc__).startswith(f"{name.rpartition('.')[2]}(")


def full_record() -> Record:
    """A record in which every field of the trace has a value that tells it from others."""
    found = record()
    outlook: Outlook = found.sites[CLOUD]._replace(quality=Quality(0.7, 0.1))
    decision = found.decision._replace(latest=Hedge("onboard", 0.9), advised="edge", spared=("edge",))
    return replace(found, sites={**found.sites, CLOUD: outlook}, decision=decision)


def equal(written: Any, value: Any) -> bool:
    """Whether a value of the trace is that of an attribute; tuples are lists in the file."""
    if isinstance(written, dict):
        named = value._asdict() if hasattr(value, "_asdict") else None
        return all(equal(one, named[key] if named else getattr(value, key)) for key, one in written.items())
    if isinstance(written, list | tuple):
        return len(written) == len(value) and all(map(equal, written, value))
    return bool(written == value)


def test_fields_of_the_trace_have_the_names_of_python_unless_the_page_says_so() -> None:
    """Every field of a line is an attribute of the record, or in the table of the page."""
    found = full_record()
    line, differing = as_dict(found), set()
    for name, written in line.items():
        if name in ("sites", "decision"):
            continue
        if name == "started_at":
            assert written.startswith(found.started_at.isoformat()[:19])
        elif not hasattr(found, name):
            differing.add(name)
        elif name == "late":
            differing.add("late.N.FIELD")
        else:
            assert equal(written, getattr(found, name)), name
    for name, written in line["decision"].items():
        same = hasattr(found.decision, name) and equal(written, getattr(found.decision, name))
        differing |= set() if same else {f"decision.{name}"}
    for name, written in line["sites"][CLOUD].items():
        same = equal(written, getattr(found.sites[CLOUD], name))
        differing |= set() if same else {f"sites.SITE.{name}"}
    assert differing == {*OTHER_NAMES}


@pytest.mark.parametrize(
    ("path", "field"),
    [
        ("decision.second.site", ("decision", "second")),
        ("decision.second.after_s", ("decision", "second_after_s")),
        ("decision.latest.after_s", ("decision", "latest_s")),
    ],
)
def test_an_attribute_of_the_table_holds_the_field(path: str, field: tuple[str, str]) -> None:
    """The right column of the table is where the value of the left one is."""
    found = full_record()
    assert OTHER_NAMES[".".join(field)].startswith(f"`{path}`")
    assert attrgetter(path)(found) == as_dict(found)[field[0]][field[1]]


def test_the_other_attributes_of_the_table_hold_their_fields() -> None:
    """Quality, features and late executions."""
    found = full_record()
    line = as_dict(found)
    assert line["sites"][CLOUD]["quality"] == found.sites[CLOUD].quality.value
    assert line["features"].pop("work") == found.amount
    names = {name.removeprefix("cloud.") for name in line["features"]}
    assert names == {*Condition._fields}
    assert all(
        getattr(found.sites[CLOUD].condition, name) == line["features"][f"cloud.{name}"] for name in names
    )
    assert line["late"][0]["id"] == found.late[0].id
    assert line["late"][0]["seconds"] == found.late[0].execution.seconds
