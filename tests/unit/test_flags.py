"""The conditions of the link have the same names as flags, in a scenario and over HTTP."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from offboard.common.command_line import load
from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.relay.control_api import Change
from offboard.loadgen.relay.link.link import CONDITIONS, Link, LinkConditions
from offboard.loadgen.relay.link.link_settings import LinkFlags, as_flags
from offboard.loadgen.scenario.scenario_file import read_scenario

NAMES = set(CONDITIONS)
RECORDED = {"recording", "up_recording", "down_recording", "recording_from_s", "recording_repeats"}
SCENARIO = """
name = "rough"

[workload]
map = "{map}"

[link]
hang = true
up_loss = 0.02
down_hang = false
down_samples = "delays.txt"
"""


def flags(*argv: str) -> LinkFlags:
    return load(LinkFlags, argv, prog="wan", description="", environ={}, prefix="WAN")


def test_each_condition_has_its_flags() -> None:
    """For both directions and for one: all but the outage, which only a running relay has."""
    both = NAMES - {"outage"}
    wanted = both | {f"up_{name}" for name in both} | {f"down_{name}" for name in both}
    assert {field.name for field in fields(LinkFlags)} == wanted | RECORDED
    assert {field.name for field in fields(LinkConditions)} == NAMES | {"recording"}
    assert set(Change.model_fields) == NAMES


def test_without_flags_the_link_is_that_of_the_paper() -> None:
    """It has a delay and a bandwidth, and none of the other effects."""
    conditions = LinkConditions(delay_ms=15, bandwidth_mbps=400)
    assert flags().link == Link(conditions, conditions)


def test_a_flag_of_one_direction_takes_precedence() -> None:
    """It overrides the flag of both directions, also with --no-."""
    link = flags("--loss=0.1", "--up-loss=0.2", "--hang", "--no-down-hang", "--down-truncate-bytes=9").link
    assert (link.up.loss, link.down.loss) == (0.2, 0.1)
    assert (link.up.hang, link.down.hang) == (True, False)
    assert (link.up.truncate_bytes, link.down.truncate_bytes) == (0, 9)


def test_samples_are_used_unless_another_distribution_is_named(tmp_path: Path) -> None:
    """--samples alone draws from the file; with --distribution the file is kept for a later change."""
    file = tmp_path / "delays.txt"
    file.write_text("3\n1\n")
    link = flags("--up-samples", str(file)).link
    assert (link.up.distribution, link.up.samples) == ("samples", (1.0, 3.0))
    assert (link.down.distribution, link.down.samples) == ("normal", ())
    assert flags("--samples", str(file), "--distribution", "uniform").link.up.distribution == "uniform"
    with pytest.raises(ConfigError, match="samples: the list is empty"):
        flags("--distribution", "samples")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--loss", "2"], "--loss: 2.0 is above 1, the maximum"),
        (["--up-loss-burst", "0.5"], "--up-loss-burst: 0.5 is below 1, the minimum"),
        (["--distribution", "gamma"], "--distribution: 'gamma' is not one of constant, uniform"),
        (["--truncate-bytes", "1.5"], "--truncate-bytes: '1.5' is not a whole number"),
    ],
)
def test_a_wrong_flag_is_named(argv: list[str], message: str) -> None:
    """The error names the flag and its value."""
    with pytest.raises(ConfigError) as caught:
        flags(*argv)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    "settings", [{"hang": True}, {"up_hang": False}, {"loss": 0.02, "distribution": "pareto", "up_loss": 0.0}]
)
def test_settings_survive_a_command_line(settings: dict[str, Any]) -> None:
    """Settings that are written as flags are read as the same settings."""
    assert flags(*as_flags(settings)) == LinkFlags(**settings)


def test_a_scenario_takes_all_conditions(tmp_path: Path) -> None:
    """[link] takes booleans, numbers and files; files are relative to the scenario."""
    grid = Path(__file__).parents[1] / "samples" / "32room_000-crop.map"
    (tmp_path / "delays.txt").write_text("5\n")
    file = tmp_path / "rough.toml"
    file.write_text(SCENARIO.format(map=grid))
    link = flags(*as_flags(read_scenario(file).link)).link
    assert (link.up.hang, link.up.loss, link.up.samples) == (True, 0.02, ())
    assert (link.down.hang, link.down.loss, link.down.samples) == (False, 0, (5.0,))
    (tmp_path / "delays.txt").write_text("five\n")
    with pytest.raises(DataError, match=r"delays.txt:1: 'five' is not a delay in ms"):
        read_scenario(file)
