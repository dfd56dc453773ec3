"""Where a setting comes from, and what a wrong one says."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from offboard.common.config import as_dict, check, load, run_command, setting
from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.robot_client.policies.allowance import DUPLICATES_MAX
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.objectives import Mean, TimeAndEnergy
from offboard.robot_client.policies.probe import STALE
from offboard.robot_client.records import trace
from offboard.robot_client.simulated.config import RobotConfig


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
    "answers.jsonl": '{"v":1,"i":0,"id":"","due_s":0,"began_s":0,"ended_s":0,"error":"","answer":null}\n',
    "open.map": "type octile\nheight 3\nwidth 3\nmap\n...\n...\n...\n",
    "text-link.toml": 'name = "odd"\n[workload]\nmap = "open.map"\n[link]\ndelay_ms = "slow"\n',
    "open.toml": 'name = "open"\n[workload]\nmap = "open.map"\n',
    "alone.toml": 'name = "alone"\n[workload]\nmap = "open.map"\ntasks = 3\nalone = 4\n',
    "no-map.toml": 'name = "odd"\n[workload]\nmap = "none.yaml"\n',
    "odd.toml": 'name = "odd"\n[workload]\nmap = "m.yaml"\ntaks = 3\n',
}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["robot_client"], "--map is missing"),
        (["robot_client", "--map", "none.yaml"], "none.yaml"),
        (["robot_client", "--task", "m:f", "--map", "open.map"], "--task: 'm:f' is not allowed beside --map"),
        (["robot_client", "--task", "m:f", "--sizes", "constant:1"], "--task: 'm:f' is not MODULE:FUNCTION"),
        (["robot_client", "--map", "open.map", "--sizes", "none.csv"], "--sizes: 'none.csv' is not"),
        (
            ["robot_client", "--map", "open.map", "--radius", "0", "--answers", "answers.jsonl"],
            "--answers: answers.jsonl holds 1 answers; going on needs --jump",
        ),
        (["robot_client", "--map", "no-resolution.yaml"], "no-resolution.yaml: resolution"),
        (["robot_client", "--map", "text-image.yaml"], "words.txt"),
        (["robot_client", "--map", "open.map", "--radius", "9"], "no room for a robot of radius 9.0 m"),
        (
            ["robot_client", "--map", "open.map", "--metrics", "127.0.0.1:99999"],
            "--metrics: '127.0.0.1:99999'",
        ),
        (
            ["robot_client", "--map", "open.map", "--policy", "paper", "--objective", "p95"],
            "--objective: p95 changes nothing with",
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
        (["loadgen", "run", "odd.toml"], "odd.toml:4: unknown key 'taks'; did you mean 'tasks'?"),
        (["loadgen", "run", "no-map.toml"], "no-map.toml: workload.map: "),
        (["cloud_server", "--tasks", "json"], "--tasks: json registers no task"),
        (["cloud_server", "--config", "."], ".: Is a directory"),
        (["loadgen", "run", "none"], "scenario 'none' is neither a file nor one of bandwidth, burst"),
        (["loadgen", "run", "text-link.toml"], "text-link.toml: link.delay_ms: 'slow' is not a number"),
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
        [sys.executable, "-m", f"offboard.{command[0]}", *command[1:]],
        capture_output=True,
        text=True,
        timeout=30,
        cwd=tmp_path,
    )
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("command", "extra"),
    [(["cloud_server"], "cloud"), (["loadgen", "wan"], "bench")],
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


MAP, TASK = {"map": Path("m.yaml")}, {"task": "m:f", "sizes": ("constant:1",)}
OPEN = {"arrivals": "poisson", "rate": 5.0}
TRACED = {"trace": Path("t"), "cloud": "tcp://h:1"}
COSTS = {"policy": "greedy"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "--map is missing"),
        (MAP | TASK, "--task: 'm:f' is not allowed beside --map m.yaml"),
        ({"task": "m:f"}, "--task: 'm:f' needs --sizes"),
        (MAP | {"sizes": ("constant",)}, "--sizes: 'constant' is not constant:X"),
        (MAP | {"arrivals": "often"}, "--arrivals: 'often' is not one of closed, constant, poisson, bursts"),
        (TASK | {"arrivals": "bursts"}, "--arrivals: bursts needs --rate"),
        (MAP | {"planner": "theta"}, "--planner: 'theta' is not one of dijkstra, astar, jps"),
        (TASK | OPEN | {"rate": 0.0}, "--rate: 0.0 is below 0.001"),
        (TASK | OPEN | {"burst": 0}, "--burst: 0 is below 1"),
        (TASK | OPEN | {"in_flight": 0}, "--in-flight: 0 is below 1"),
        (TASK | OPEN | {"in_flight": 1025}, "--in-flight: 1025 is above 1024"),
        (MAP | OPEN, "--arrivals: poisson on a map needs --jump"),
        (TASK | OPEN | {"measure": 1}, "--measure: 1 needs --arrivals closed"),
        (TASK | OPEN | TRACED | {"alone": 2}, "--alone: 2 needs --arrivals closed"),
        (TASK | OPEN | TRACED | {"reference": 3}, "--reference: 3 needs --arrivals closed"),
        (TASK | TRACED | {"reference": 3, "trace": None}, "--reference: 3 needs --trace"),
        (TASK | TRACED | {"reference": 3, "cloud": None}, "--reference: 3 needs --cloud"),
        (MAP | TRACED | {"reference": 3}, "--reference: 3 on a map needs --jump"),
        (MAP | {"reference": -1}, "--reference: -1 is below 0"),
        (MAP | {"trace": Path("t"), "answers": Path("t")}, "--answers: t is the file of --trace"),
        (MAP | {"trace": Path("t"), "memory": Path("t")}, "--memory: t is the file of --trace or --answers"),
        (
            MAP | COSTS | {"objective": "fast"},
            "--objective: 'fast' is not one of mean, p95, deadline, energy",
        ),
        (MAP | COSTS | {"objective": "deadline"}, "--objective: deadline needs --deadline"),
        (MAP | COSTS | {"objective": "energy"}, "--objective: energy needs --s-per-joule"),
        (MAP | COSTS | {"deadline_s": 0.5}, "--deadline: 0.5 needs --objective deadline"),
        (MAP | COSTS | {"s_per_joule": 2.0}, "--s-per-joule: 2 needs --objective energy"),
        (MAP | COSTS | {"objective": "deadline", "deadline_s": 0.0}, "--deadline: 0.0 is below 0.001"),
        (
            MAP | {"objective": "p95", "policy": "paper"},
            "--objective: p95 changes nothing with --policy paper",
        ),
        (MAP | {"objective": "p95", "policy": "hedge:cloud"}, "--objective: p95 changes nothing with"),
        (MAP | {"duplicates": 1.5}, "--duplicates: 1.5 is above 1"),
        (MAP | {"compute_watts": -1.0}, "--compute-watts: -1.0 is below 0"),
        (MAP | {"bytes_per_minute": -1.0}, "--bytes-per-minute: -1.0 is below 0"),
        (MAP | {"joules_per_minute": float("nan")}, "--joules-per-minute: nan is below 0"),
    ],
)
def test_a_workload_that_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    """Flags that contradict each other are named with their values, before anything is opened."""
    with pytest.raises(ConfigError) as caught:
        RobotConfig(**settings)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    "settings",
    [
        MAP,
        TASK | OPEN,
        MAP | OPEN | {"jump": True, "arrivals": "bursts"},
        MAP | TRACED | {"jump": True, "reference": 10, "measure": 5, "alone": 5},
        TASK | TRACED | {"reference": 1},
        MAP | {"policy": "hedge:greedy", "objective": "deadline", "deadline_s": 0.2},
        MAP | {"bytes_per_minute": 1e6, "joules_per_minute": 60.0, "duplicates": 0.0, "memory": Path("m")},
    ],
)
def test_a_workload_that_can_be_is_taken(settings: dict[str, Any]) -> None:
    """What is asked for together and goes together is no error."""
    assert RobotConfig(**settings).in_flight == 16


def test_the_flags_of_cost_become_what_the_offloader_is_given() -> None:
    """Objective, energy and allowance are made of the flags; by default those of the library."""
    plain = RobotConfig(**MAP)
    assert isinstance(plain.settings().objective, Mean)
    assert plain.settings().energy == Energy()
    assert not plain.settings().allowance().capped
    flags = "--objective energy --s-per-joule 2 --compute-watts 3 --idle-watts 0.5 --radio-joules-byte 1e-6"
    caps = "--policy greedy --bytes-per-minute 6000 --joules-per-minute 60 --duplicates 0.5"
    config = load(
        RobotConfig,
        ["--map", "m", *flags.split(), *caps.split()],
        prog="r",
        description="",
        environ={},
        prefix="R",
    )
    assert config.settings().objective == TimeAndEnergy(2.0)
    assert config.settings().energy == Energy(3.0, 0.5, 1e-6)
    allowance = config.settings().allowance()
    allowance.begin(0.0)
    assert (allowance.duplicates, allowance.bytes_left, allowance.joules_left) == (
        DUPLICATES_MAX,
        6000.0,
        60.0,
    )


def test_a_command_keeps_and_uses_its_memory(tmp_path: Path) -> None:
    """With --memory the second run begins with what the first one learnt; a folder is refused."""
    (tmp_path / "mine.py").write_text(
        "from offboard.common.tasks import task\n"
        "@task('mine', size=lambda number: number)\n"
        "def mine(number: int) -> int:\n"
        "    return number\n"
    )
    flags = "--task mine:mine --sizes uniform:1:9 --window 5 --memory memory.json --trace trace.jsonl --tasks"
    for tasks in ("8", "1"):
        command = [sys.executable, "-m", "offboard.robot_client", *flags.split(), tasks]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    records = list(trace.read(tmp_path / "trace.jsonl"))
    assert records[0]["sites"]["onboard"]["predicted_s"] is None
    assert records[8]["sites"]["onboard"]["predicted_s"] is not None
    assert (records[8]["i"], records[8]["sites"]["onboard"]["age"]) == (0, STALE)
    command = [sys.executable, "-m", "offboard.robot_client", *flags.replace("memory.json", ".").split(), "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, "robot-client: memory .: is a folder\n")
