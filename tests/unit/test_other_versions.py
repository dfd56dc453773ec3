"""What a server says of robots with another version of Offboard."""

import logging

import pytest

from offboard.cloud_server.connections import NAMES_SHOWN, VERSIONS_MAX, OtherVersions
from offboard.common import VERSION
from offboard.common.tasks import hashes, task
from offboard.common.wire.messages import Hello


def said(hellos: list[Hello], caplog: pytest.LogCaptureFixture) -> list[str]:
    caplog.clear()
    others = OtherVersions()
    with caplog.at_level(logging.WARNING, "offboard.cloud_server"):
        for hello in hellos:
            others.hear(hello)
    return [record.getMessage() for record in caplog.records]


@pytest.fixture
def here() -> dict[str, str]:
    """The hashes of this server, which has a task."""

    def heard(x: float) -> float:
        return x

    task("heard_of", size=float)(heard)
    return hashes()


@pytest.mark.usefixtures("here")
def test_both_versions_are_named_once(caplog: pytest.LogCaptureFixture) -> None:
    """A robot of version 0.1.0 cannot say it by itself: it blames the source of the task."""
    hello = Hello({"heard_of": "f" * 64, "not_known_here": "a"}, "0.1.0", 1)
    both = f"or is only hashed in another way: Offboard 0.1.0 there, {VERSION} here"
    remedy = "install the same version of Offboard, and of the tasks, on both sides"
    line = f"a robot keeps heard_of onboard: the source differs, {both}; remedy: {remedy}"
    assert said([hello] * 3, caplog) == [line]


def test_the_same_hash_or_the_same_version_is_no_news(
    here: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    """Robots say why their tasks stay onboard; the files of a task may not be read yet."""
    name, one = "heard_of", here["heard_of"]
    hellos = [Hello({name: one}, "0.1.0", 1), Hello({name: one + "f" * 64}, "0.1.0", 1)]
    assert said([*hellos, Hello({name: "f" * 64}, VERSION, 1), Hello({}, "0.1.0", 1)], caplog) == []


def test_a_robot_that_claims_many_versions_fills_no_log(
    here: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    """At most VERSIONS_MAX lines are logged, and each names a few tasks."""
    there = dict.fromkeys(here, "f" * 64)
    lines = said([Hello(there, str(number), 1) for number in range(100)], caplog)
    assert len(lines) == VERSIONS_MAX
    assert all(line.split(" onboard: ")[0].count(",") < NAMES_SHOWN for line in lines)
