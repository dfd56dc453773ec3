"""Where a setting comes from, and what the error of a wrong one says."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from offboard.common.command_line import load
from offboard.common.config import as_dict, check, setting
from offboard.common.errors import ConfigError, DataError


@dataclass(frozen=True)
class Settings:
    window: int = setting(50, "executions remembered", minimum=2, maximum=100)
    timeout_s: float = setting(2.0, "seconds to wait", name="timeout", minimum=0.1)
    policy: str = setting("paper", "where to run", choices=("paper", "cloud"))
    site: tuple[str, ...] = setting((), "a server")
    trace: Path | None = setting(None, "file")
    fast: bool = setting(False, "be quick")

    def __post_init__(self) -> None:
        check(self)


def settings(*argv: str, environ: dict[str, str] | None = None) -> Settings:
    return load(Settings, argv, prog="tool", description="A tool.", environ=environ or {}, prefix="TOOL")


def test_flag_beats_environment_beats_file_beats_default(tmp_path: Path) -> None:
    """For each setting, the first source that has it wins."""
    file = tmp_path / "tool.toml"
    file.write_text("window = 10\ntimeout = 3\npolicy = 'cloud'\nsite = ['a=b', 'c=d']\n")
    got = settings(
        "--config", str(file), "--window", "30", environ={"TOOL_WINDOW": "20", "TOOL_TIMEOUT": "4"}
    )
    assert got == Settings(window=30, timeout_s=4.0, policy="cloud", site=("a=b", "c=d"))


def test_a_list_is_given_with_commas_or_repeated_flags() -> None:
    """A list takes several values in one flag, and several flags."""
    assert settings("--site", "a,b", "--site", "c").site == ("a", "b", "c")


def test_a_boolean_flag_needs_no_value() -> None:
    """--fast means true; --no-fast overrides the environment."""
    assert settings("--fast").fast
    assert not settings(environ={"TOOL_FAST": "no"}).fast
    assert settings(environ={"TOOL_FAST": "yes"}).fast
    assert not settings("--no-fast", environ={"TOOL_FAST": "yes"}).fast


@pytest.mark.parametrize(
    ("argv", "environ", "message"),
    [
        (["--window", "0"], {}, "--window: 0 is below 2, the minimum"),
        (["--window", "101"], {}, "--window: 101 is above 100, the maximum"),
        (["--window", "x"], {}, "--window: 'x' is not a whole number"),
        (["--timeout", "nan"], {}, "--timeout: nan is below 0.1, the minimum"),
        ([], {"TOOL_TIMEOUT": "soon"}, "TOOL_TIMEOUT: 'soon' is not a number"),
        (["--policy", "papr"], {}, "--policy: 'papr' is not one of paper, cloud"),
        ([], {"TOOL_FAST": "maybe"}, "TOOL_FAST: 'maybe' is neither true nor false"),
    ],
)
def test_a_wrong_value_names_its_source_and_what_is_allowed(
    argv: list[str], environ: dict[str, str], message: str
) -> None:
    """The error names the source, the value, and the bound or the choices."""
    with pytest.raises(ConfigError) as caught:
        settings(*argv, environ=environ)
    assert str(caught.value) == message


def test_an_unknown_key_names_file_line_and_the_nearest_key(tmp_path: Path) -> None:
    """A misspelt key in the file is refused."""
    file = tmp_path / "tool.toml"
    file.write_text("# settings\nwindow = 10\npolcy = 'cloud'\n")
    with pytest.raises(DataError) as caught:
        settings("--config", str(file))
    assert str(caught.value) == f"{file}:3: unknown key 'polcy'; did you mean 'policy'?"


@pytest.mark.parametrize(
    ("name", "text", "message"), [("none.toml", None, "no such file"), ("bad.toml", "a = = 1", "line 1")]
)
def test_a_bad_config_file_is_named(tmp_path: Path, name: str, text: str | None, message: str) -> None:
    """The error of a missing or broken file names the file and the line."""
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=message):
        settings("--config", str(tmp_path / name))


def test_a_config_made_in_code_is_checked_as_well() -> None:
    """The dataclass itself checks the bounds."""
    with pytest.raises(ConfigError, match="--window: 1 is below 2"):
        Settings(window=1)


def test_settings_are_shown_by_the_names_of_their_flags() -> None:
    """The names in /config and in the start log are the names of the flags."""
    assert as_dict(Settings(trace=Path("x"), site=("a",))) == {
        "window": 50,
        "timeout": 2.0,
        "policy": "paper",
        "site": ["a"],
        "trace": "x",
        "fast": False,
    }
