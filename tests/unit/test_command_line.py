"""Sub-commands, help and exit codes: what a user sees of a command line."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from offboard.__main__ import main
from offboard.cloud_server.config import ServerConfig
from offboard.common import VERSION
from offboard.common.command_line import Command, CommandParser, add_flags, load, run_command, run_commands
from offboard.common.config import REQUIRED, flag_of, setting, settings_of
from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.common.security.keys import KeysConfig
from offboard.loadgen.__main__ import DemoConfig, RunConfig
from offboard.loadgen.claims.claim import ClaimsConfig
from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.export.export import ExportConfig
from offboard.loadgen.play.measure_dataset import DatasetConfig
from offboard.loadgen.relay.wan import WanConfig
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.report.report import ReportConfig
from offboard.loadgen.robot.config import CallConfig, DriveConfig
from offboard.loadgen.table.table_settings import TableConfig

SHOWN_MAX = 17  # flags in --help; --help itself and --version included
CONFIGS = (
    DriveConfig,
    CallConfig,
    ServerConfig,
    KeysConfig,
    WanConfig,
    RunConfig,
    DemoConfig,
    CompareConfig,
    TableConfig,
    ClaimsConfig,
    ReplayConfig,
    ReportConfig,
    DatasetConfig,
    ExportConfig,
)


@dataclass(frozen=True)
class Settings:
    map: Path = setting(REQUIRED, "where to drive", group="task")
    beams: int = setting(360, "beams of the LiDAR", group="sensor", rare=True)
    speed: float = setting(1.0, "in m/s", group="task")
    noise: float = setting(0.0, "of the LiDAR", group="sensor", rare=True)


def shown(argv: list[str], cls: type, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as caught:
        load(cls, argv, prog="tool", description="A tool.", environ={}, prefix="TOOL")
    assert caught.value.code == 0
    return capsys.readouterr().out


def flags_in(help: str) -> list[str]:
    """The flags that a help text explains."""
    return re.findall(r"^  (?:-h, )?--([a-z0-9-]+)", help, re.MULTILINE)


@pytest.mark.parametrize("cls", CONFIGS)
def test_help_shows_the_common_flags_and_help_all_shows_all(
    cls: type, capsys: pytest.CaptureFixture[str]
) -> None:
    """--help has at most 16 flags next to --version, and no rare one; --help-all has every field."""
    common = flags_in(shown(["--help"], cls, capsys))
    assert len(common) <= SHOWN_MAX, common
    fields = settings_of(cls)
    rare = [flag_of(field) for field in fields if field.metadata["rare"]]
    assert set(common) >= {flag_of(field) for field in fields} - set(rare)
    assert not set(common) & set(rare)
    if rare:
        assert set(flags_in(shown(["--help-all"], cls, capsys))) >= {flag_of(field) for field in fields}


def test_groups_with_common_flags_come_first(capsys: pytest.CaptureFixture[str]) -> None:
    """Groups are in the order of their fields, after which come the groups of rare flags only."""
    everything = shown(["--help-all"], Settings, capsys)
    assert re.findall(r"^(\w+):$", everything, re.MULTILINE) == ["options", "task", "sensor"]
    common = shown(["--help"], Settings, capsys)
    assert re.findall(r"^(\w+):$", common, re.MULTILINE) == ["options", "task"]
    assert "where to drive (required)" in common
    assert "--one-flag as TOOL_ONE_FLAG" in common


def test_operands_are_in_the_usage() -> None:
    """The usage line has the arguments without dashes, and is short."""
    parser = CommandParser(prog="tool", description=None, operands="FILE")
    add_flags(parser, Settings, "TOOL")
    assert parser.format_usage() == "usage: tool FILE [options]\n"


def test_an_unknown_flag_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    """The error names the flag, the nearest known flag, and the command that explains the flags."""
    with pytest.raises(SystemExit) as caught:
        load(Settings, ["--spede", "3"], prog="tool", description="", environ={}, prefix="TOOL")
    assert caught.value.code == 2
    assert (
        capsys.readouterr().err
        == "tool: unrecognized arguments: --spede 3; did you mean --speed? (see tool --help)\n"
    )


@dataclass(frozen=True)
class Flags:
    cloud: str | None = setting(None, "one server")
    rate: float = setting(1.0, "per second")
    jump: bool = setting(False, "do it")
    site: tuple[str, ...] = setting((), "many servers")


@pytest.mark.parametrize(
    ("argv", "twice"),
    [
        (["--cloud", "a", "--rate", "3", "--cloud", "b"], "--cloud"),
        (["--cloud=a", "--cloud=a"], "--cloud"),
        (["--rate", "0", "--rate", "3"], "--rate"),
        (["--jump", "--no-jump"], "--no-jump"),
        (["--config", "a.toml", "--config", "b.toml"], "--config"),
    ],
)
def test_a_flag_with_one_value_is_given_once(
    argv: list[str], twice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second one is an error with one line and exit code 2, never a value that replaces the first."""
    with pytest.raises(SystemExit) as caught:
        load(Flags, argv, prog="tool", description="", environ={}, prefix="TOOL")
    assert caught.value.code == 2
    said = f"tool: {twice} is given twice, but takes one value (see tool --help)\n"
    assert capsys.readouterr().err == said


def test_a_flag_with_many_values_can_be_repeated() -> None:
    """The values of all of them count; a flag still wins over the environment."""
    environ = {"TOOL_CLOUD": "c"}
    argv = ["--site", "a", "--site", "b,c", "--cloud", "a"]
    flags = load(Flags, argv, prog="tool", description="", environ=environ, prefix="TOOL")
    assert (flags.site, flags.cloud) == (("a", "b", "c"), "a")


@pytest.mark.parametrize(
    ("error", "code"), [(ConfigError("c"), 2), (DataError("d"), 2), (OffloadError("o"), 1)]
)
def test_an_error_becomes_one_line_and_an_exit_code(
    error: OffloadError, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistake of the user ends with 2, a failed run with 1, both without a traceback."""

    def fail() -> int:
        raise error

    assert run_command("tool", fail) == code
    assert capsys.readouterr().err == f"tool: {error}\n"


def commands(called: list[Any]) -> dict[str, Command]:
    def drive(argv: Any) -> int:
        called.append(argv)
        return 3

    def fail(_: Any) -> int:
        raise ConfigError("no keys")

    return {"drive": Command("drive on a map", drive), "keys": Command("make keys", fail)}


def test_a_command_gets_the_arguments_after_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    """Its exit code is returned, and its errors name the command."""
    called: list[Any] = []
    assert run_commands("tool", "A tool.", commands(called), ["drive", "--map", "m"]) == 3
    assert called == [["--map", "m"]]
    assert run_commands("tool", "A tool.", commands(called), ["keys"]) == 2
    assert capsys.readouterr().err == "tool keys: no keys\n"


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "tool: a command is missing"),
        (["driv"], "tool: unknown command 'driv'; did you mean 'drive'?"),
        (["--map", "m"], "tool: unknown command '--map'; known: drive, keys"),
    ],
)
def test_without_a_command_the_usage_is_an_error(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The usage has a line for each command, the last line says what is wrong, and the exit code is 2."""
    assert run_commands("tool", "A tool.", commands([]), argv) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == said
    assert {"usage: tool COMMAND ...", "  drive  drive on a map", "  keys   make keys"} <= set(lines)


def test_help_prints_the_usage(capsys: pytest.CaptureFixture[str]) -> None:
    """--help prints the same usage to stdout, with exit code 0."""
    assert run_commands("tool", "A tool.", commands([]), ["--help"]) == 0
    assert "  drive  drive on a map\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ([], "offboard"),
        (["client"], "robot-client"),
        (["server"], "cloud-server"),
        (["bench"], "loadgen"),
    ],
)
def test_each_command_prints_its_version(
    words: list[str], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """--version prints the name of the command and the version of Offboard, with exit code 0."""
    try:
        code: object = main([*words, "--version"])
    except SystemExit as ended:
        code = ended.code
    assert (code, capsys.readouterr().out) == (0, f"{name} {VERSION}\n")
