"""Where a setting comes from, and what a wrong one says."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from common.config import as_dict, check, load, run_command, setting
from common.errors import ConfigError, DataError, OffloadError


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
    """The nearest source wins, setting by setting."""
    file = tmp_path / "tool.toml"
    file.write_text("window = 10\ntimeout = 3\npolicy = 'cloud'\nsite = ['a=b', 'c=d']\n")
    got = settings(
        "--config", str(file), "--window", "30", environ={"TOOL_WINDOW": "20", "TOOL_TIMEOUT": "4"}
    )
    assert got == Settings(window=30, timeout_s=4.0, policy="cloud", site=("a=b", "c=d"))


def test_lists_come_with_commas_or_again() -> None:
    """A list setting takes its flag more than once, and commas."""
    assert settings("--site", "a,b", "--site", "c").site == ("a", "b", "c")


def test_a_switch_needs_no_value() -> None:
    """--fast alone is true; the environment may say so or not, and --no-fast overrules it."""
    assert settings("--fast").fast
    assert not settings(environ={"TOOL_FAST": "no"}).fast
    assert settings(environ={"TOOL_FAST": "yes"}).fast
    assert not settings("--no-fast", environ={"TOOL_FAST": "yes"}).fast


@pytest.mark.parametrize(
    ("argv", "environ", "message"),
    [
        (["--window", "0"], {}, "--window: 0 is below 2, the least allowed"),
        (["--window", "101"], {}, "--window: 101 is above 100, the most allowed"),
        (["--window", "x"], {}, "--window: 'x' is not a whole number"),
        (["--timeout", "nan"], {}, "--timeout: nan is below 0.1, the least allowed"),
        ([], {"TOOL_TIMEOUT": "soon"}, "TOOL_TIMEOUT: 'soon' is not a number"),
        (["--policy", "papr"], {}, "--policy: 'papr' is not one of paper, cloud"),
        ([], {"TOOL_FAST": "maybe"}, "TOOL_FAST: 'maybe' is neither true nor false"),
    ],
)
def test_a_wrong_value_names_its_source_and_what_is_allowed(
    argv: list[str], environ: dict[str, str], message: str
) -> None:
    """One line: where it was set, the value, the bound or the choices."""
    with pytest.raises(ConfigError) as caught:
        settings(*argv, environ=environ)
    assert str(caught.value) == message


def test_an_unknown_key_names_file_line_and_the_nearest_key(tmp_path: Path) -> None:
    """A misspelt key in the file is refused, not ignored."""
    file = tmp_path / "tool.toml"
    file.write_text("# settings\nwindow = 10\npolcy = 'cloud'\n")
    with pytest.raises(DataError) as caught:
        settings("--config", str(file))
    assert str(caught.value) == f"{file}:3: unknown key 'polcy'; did you mean 'policy'?"


@pytest.mark.parametrize(
    ("name", "text", "message"), [("none.toml", None, "no such file"), ("bad.toml", "a = = 1", "line 1")]
)
def test_a_bad_config_file_is_named(tmp_path: Path, name: str, text: str | None, message: str) -> None:
    """A missing or broken file says which one and where."""
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=message):
        settings("--config", str(tmp_path / name))


def test_the_same_check_holds_for_a_config_made_in_code() -> None:
    """The bounds are those of the dataclass, not of the command line."""
    with pytest.raises(ConfigError, match="--window: 1 is below 2"):
        Settings(window=1)


def test_an_unknown_flag_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    """argparse's page of usage is left to --help."""
    with pytest.raises(SystemExit) as caught:
        settings("--windw", "3")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "tool: unrecognized arguments: --windw 3 (see tool --help)\n"


def test_the_resolved_settings_are_shown_under_their_flag_names() -> None:
    """What /config and the start log print can be typed back."""
    assert as_dict(Settings(trace=Path("x"), site=("a",))) == {
        "window": 50,
        "timeout": 2.0,
        "policy": "paper",
        "site": ["a"],
        "trace": "x",
        "fast": False,
    }


@pytest.mark.parametrize(
    ("error", "code"), [(ConfigError("c"), 2), (DataError("d"), 2), (OffloadError("o"), 1)]
)
def test_errors_become_one_line_and_a_code(
    error: OffloadError, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """A user's mistake ends with 2, a failed run with 1, both without a traceback."""

    def fail() -> int:
        raise error

    assert run_command("tool", fail) == code
    assert capsys.readouterr().err == f"tool: {error}\n"


YAML = "origin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
FILES = {
    "no-resolution.yaml": "image: map.pgm\n" + YAML,
    "text-image.yaml": "image: words.txt\nresolution: 0.1\n" + YAML,
    "words.txt": "not an image",
    "bad.jsonl": '{"v": 1}\nnonsense\n',
    "text.csv": "size,onboard_s,cloud_s\n1,2,3\n1,two,3\n",
    "empty.csv": "",
    "open.map": "type octile\nheight 3\nwidth 3\nmap\n...\n...\n...\n",
    "text-link.toml": 'name = "odd"\n[workload]\nmap = "open.map"\n[link]\ndelay_ms = "slow"\n',
    "open.toml": 'name = "open"\n[workload]\nmap = "open.map"\n',
    "alone.toml": 'name = "alone"\n[workload]\nmap = "open.map"\ntasks = 3\nalone = 4\n',
    "no-map.toml": 'name = "odd"\n[workload]\nmap = "none.yaml"\n',
    "odd.toml": 'name = "odd"\n[workload]\nmap = "m.yaml"\ntask = 3\n',
}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["robot_client"], "--map is missing"),
        (["robot_client", "--map", "none.yaml"], "none.yaml"),
        (["robot_client", "--map", "no-resolution.yaml"], "no-resolution.yaml: resolution"),
        (["robot_client", "--map", "text-image.yaml"], "words.txt"),
        (["robot_client", "--map", "open.map", "--radius", "9"], "no room for a robot of radius 9.0 m"),
        (
            ["robot_client", "--map", "open.map", "--metrics", "127.0.0.1:99999"],
            "--metrics: '127.0.0.1:99999'",
        ),
        (
            ["robot_client", "--map", "open.map", "--trace", "words.txt"],
            "words.txt: the file is there and is no",
        ),
        (["robot_client", "--map", "m.yaml", "--window", "0"], "--window: 0 is below 2"),
        (["robot_client", "--map", "m.yaml", "--policy", "x"], "'x' is not one of paper, onboard, cloud"),
        (
            ["robot_client", "--map", "m.yaml", "--cloud", "tcp:/x"],
            "--cloud: 'tcp:/x' is not tcp://HOST:PORT",
        ),
        (["robot_client", "--map", "m.yaml", "--site", "edge"], "--site: 'edge' is not NAME=tcp://HOST:PORT"),
        (
            ["robot_client", "--map", "m.yaml", "--trace", "t", "--alone", "3"],
            "--alone: 3 plans cannot be measured without --cloud",
        ),
        (
            ["robot_client", "--map", "m.yaml", "--cloud", "tcp://h:1", "--alone", "3"],
            "--alone: 3 plans cannot be measured without --trace",
        ),
        (
            ["robot_client", "--map", "m.yaml", "--tasks", "3", "--alone", "4"],
            "--alone: 4 is above --tasks 3",
        ),
        (["loadgen", "run", "alone.toml"], "alone.toml: workload.alone: 4 is above workload.tasks 3"),
        (["cloud_server", "--listen", "localhost"], "--listen: 'localhost'"),
        (["cloud_server", "--tasks", "no.such.module"], "'no.such.module' cannot be imported"),
        (["loadgen"], "COMMAND"),
        (["loadgen", "tabel"], "tabel"),
        (["loadgen", "table", "none.csv"], "none.csv"),
        (["loadgen", "table", "text.csv"], "text.csv:3: onboard_s"),
        (["loadgen", "table", "empty.csv"], "empty.csv"),
        (["loadgen", "table", "bad.jsonl"], "bad.jsonl:1: no field"),
        (["loadgen", "table", "text.csv", "--windows", "0"], "--windows: '0'"),
        (["loadgen", "run", "odd.toml"], "odd.toml:4: unknown key 'task'; did you mean 'tasks'?"),
        (["loadgen", "run", "no-map.toml"], "no-map.toml: workload.map: "),
        (["cloud_server", "--tasks", "json"], "--tasks: json registers no task"),
        (["cloud_server", "--config", "."], ".: Is a directory"),
        (["loadgen", "run", "none"], "scenario 'none' is neither a file nor one of congested, demo, paper"),
        (["loadgen", "run", "text-link.toml"], "text-link.toml: link.delay-ms: 'slow' is not a number"),
        (["loadgen", "run", "open.toml", "--out", "words.txt"], "--out: words.txt cannot be written to"),
        (["loadgen", "wan", "--delay-ms", "-1"], "--delay-ms: -1"),
        (["loadgen", "wan", "--to", "nowhere"], "--to: 'nowhere' is not HOST:PORT"),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(
    command: list[str], message: str, tmp_path: Path
) -> None:
    """Every command says what is wrong in one line on stderr, without a traceback."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, timeout=30, cwd=tmp_path
    )
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("command", "extra"),
    [(["cloud_server"], "cloud"), (["loadgen", "wan"], "bench"), (["loadgen", "run", "demo"], "bench")],
)
def test_a_missing_extra_is_named(command: list[str], extra: str) -> None:
    """Without the optional libraries a command says what to install, exit code 2."""
    probe = (
        "import runpy, sys\n"
        "sys.modules['uvicorn'] = sys.modules['fastapi'] = None\n"
        f"sys.argv = {command!r}\n"
        "runpy.run_module(sys.argv[0], run_name='__main__')\n"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr.endswith(f"pip install 'offboard[{extra}]'\n")
    assert len(done.stderr.splitlines()) == 1


def test_a_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    """`loadgen table ... | head -1` ends quietly."""
    rows = "\n".join(f"{n},{n},1" for n in range(1, 40))
    (tmp_path / "rows.csv").write_text(f"size,onboard_s,cloud_s\n{rows}\n")
    table = f"{sys.executable} -m loadgen table rows.csv --windows {','.join(map(str, range(2, 35)))}"
    done = subprocess.run(
        f"{table} --format json | true", shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=30
    )
    assert done.stderr == ""
