"""The settings of `loadgen drive` and `call`: which go together, and what is made from them."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from offboard.common.command_line import load
from offboard.common.errors import ConfigError
from offboard.loadgen.robot.config import CallConfig, DriveConfig, RobotConfig
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client import policies
from offboard.robot_client.policies.allowance import DUPLICATES_MAX
from offboard.robot_client.policies.objectives import S_PER_QUALITY, Energy, Mean, TimeAndSpending
from offboard.robot_client.policies.probe import PROBE_EVERY

MAP, TASK = {"map": Path("m.yaml")}, {"task": "m:f", "sizes": ("constant:1",)}
OPEN = {"arrivals": "poisson", "rate": 5.0}
TRACED = {"trace": Path("t"), "cloud": "tcp://h:1"}
COSTS = {"policy": "greedy"}


def config(settings: dict[str, Any]) -> RobotConfig:
    """The config of `drive` or of `call`, whichever has these settings."""
    return DriveConfig(**settings) if "map" in settings else CallConfig(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "m:f"}, "--task: 'm:f' needs --sizes"),
        (MAP | {"sizes": ("constant",)}, "--sizes: 'constant' is not constant:X"),
        (MAP | {"arrivals": "often"}, "--arrivals: 'often' is not one of closed, constant, poisson, bursts"),
        (TASK | {"arrivals": "bursts"}, "--arrivals: bursts needs --rate"),
        (MAP | {"planner": "theta"}, "--planner: 'theta' is not one of dijkstra, astar, jps"),
        (TASK | {"rate": 5.0}, "--rate: 5 needs --arrivals, which is closed otherwise"),
        (TASK | {"keys": Path("keys")}, "--keys: keys needs --cloud, the server to use"),
        (TASK | {"site": ("gpu=ws://h:1",)}, "--site gpu: 'ws://h:1' is not encrypted; use wss://"),
        (
            TASK | {"site": ("gpu=ws://h:0",)},
            "--site gpu: 'ws://h:0' is not ws://HOST:PORT or wss://HOST:PORT",
        ),
        (TASK | {"site": ("gpu=dns://h",)}, "--site gpu: 'dns://h' is not dns://HOST:PORT with a port"),
        (
            TASK | {"site": ("cloud=dns://h:1",), "cloud": "tcp://h:1"},
            "--site: 'cloud=dns://h:1': the name 'cloud' is already taken",
        ),
        (
            TASK | {"site": ("gpu=tcp://h:1",), "sites": "s.toml"},
            "--sites: s.toml cannot be combined with --site; list all servers in it",
        ),
        (
            TASK | {"sites": "s.toml", "reference": 5, "trace": "t", "cloud": "tcp://h:1"},
            "--reference: 5 needs servers that stay, so no --sites",
        ),
        (TASK | {"site": ("gpu=http://h",)}, "--site gpu: 'http://h' is not tcp://HOST:PORT with a port"),
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
        (MAP | {"trace": Path("t"), "answers": Path("t")}, "--answers: t is also the file of --trace"),
        (
            MAP | {"trace": Path("t"), "memory": Path("t")},
            "--memory: t is also the file of --trace or --answers",
        ),
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
        (
            MAP | {"s_per_quality": 2.0, "policy": "paper"},
            "--s-per-quality: 2 changes nothing with --policy paper",
        ),
        (
            MAP | COSTS | {"s_per_quality": 0.0, "objective": "deadline", "deadline_s": 0.5},
            "--s-per-quality: 0 changes nothing with --objective deadline",
        ),
        (MAP | COSTS | {"s_per_quality": -1.0}, "--s-per-quality: -1.0 is below 0"),
        (MAP | {"duplicates": 1.5}, "--duplicates: 1.5 is above 1"),
        (MAP | {"compute_w": -1.0}, "--compute-w: -1.0 is below 0"),
        (MAP | {"bytes_a_minute": -1.0}, "--bytes-a-minute: -1.0 is below 0"),
        (MAP | {"joules_a_minute": float("nan")}, "--joules-a-minute: nan is below 0"),
    ],
)
def test_flags_that_contradict_each_other_are_refused(settings: dict[str, Any], message: str) -> None:
    """Flags that contradict each other are named with their values, before any file is opened."""
    with pytest.raises(ConfigError) as caught:
        config(settings)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    "settings",
    [
        MAP,
        TASK | OPEN,
        MAP | OPEN | {"jump": True, "arrivals": "bursts"},
        MAP | TRACED | {"jump": True, "reference": 10, "measure": 5, "alone": 5},
        TASK | TRACED | {"reference": 1},
        TASK | {"site": ("cloud=dns://planners.local:5555",), "keys": Path("k")},
        TASK | {"sites": Path("sites.toml"), "keys": Path("k"), "cloud": "tcp://h:1"},
        TASK | {"site": ("gpu=ws://h:1/v1", "other=wss://h", "third=ws://127.0.0.1:1"), "insecure": True},
        MAP | {"policy": "hedge:greedy", "objective": "deadline", "deadline_s": 0.2},
        MAP | {"policy": "greedy", "s_per_quality": 0.0},
        MAP | {"bytes_a_minute": 1e6, "joules_a_minute": 60.0, "duplicates": 0.0, "memory": Path("m")},
    ],
)
def test_flags_that_fit_together_are_accepted(settings: dict[str, Any]) -> None:
    """Flags that fit together are accepted."""
    assert config(settings).in_flight == 16


def test_objective_energy_and_limits_are_made_from_the_flags() -> None:
    """Without flags they are the defaults of the library."""
    plain = DriveConfig(**MAP)
    assert isinstance(plain.settings().objective, Mean)
    assert plain.settings().energy == Energy()
    assert not plain.settings().allowance().capped
    assert plain.settings().s_per_quality == S_PER_QUALITY
    flags = "--objective energy --s-per-joule 2 --compute-w 3 --idle-w 0.5 --radio-j-byte 1e-6"
    caps = "--s-per-quality 3 --policy greedy --bytes-a-minute 6000 --joules-a-minute 60 --duplicates 0.5"
    config = load(
        DriveConfig,
        ["--map", "m", *flags.split(), *caps.split()],
        prog="r",
        description="",
        environ={},
        prefix="R",
    )
    assert config.settings().objective == TimeAndSpending(2.0)
    assert config.settings().s_per_quality == 3.0
    assert config.settings().energy == Energy(3.0, 0.5, 1e-6)
    allowance = config.settings().allowance()
    allowance.begin(0.0)
    assert (allowance.duplicates, allowance.bytes_left, allowance.joules_left) == (
        DUPLICATES_MAX,
        6000.0,
        60.0,
    )


@pytest.mark.parametrize(
    ("policy", "flags", "beats"),
    [
        ("paper", (), False),
        ("paper", ("--heartbeats",), True),
        ("paper-with-heartbeats", (), True),
        ("default", (), True),
        ("default", ("--no-heartbeats",), False),
    ],
)
def test_a_flag_switches_heartbeats(policy: str, flags: tuple[str, ...], beats: bool) -> None:
    """Without the flag, the policy says whether there are heartbeats."""
    given = [f"--policy={policy}", "--map=m.yaml", *flags]
    made = load(DriveConfig, given, prog="r", description="", environ={}, prefix="R")
    assert made.settings().beats(policy) == beats


@pytest.mark.parametrize("cls", [DriveConfig, CallConfig])
def test_the_help_explains_the_default_policy(
    cls: type[RobotConfig], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says what `default` stands for, and what that does."""
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        load(cls, ["--help"], prog="r", description="", environ={}, prefix="R")
    help = capsys.readouterr().out
    assert f"`default` stands for {policies.DEFAULT}: run a task where it should finish first" in help


def test_a_second_run_starts_with_what_the_first_one_learnt(tmp_path: Path) -> None:
    """With --memory, the second run has predictions from its first task on; a folder is refused."""
    (tmp_path / "mine.py").write_text(
        "from offboard.common.tasks import task\n"
        "@task('mine', size=lambda number: number)\n"
        "def mine(number: int) -> int:\n"
        "    return number\n"
    )
    flags = "--task mine:mine --sizes uniform:1:9 --window 5 --memory memory.json --trace trace.jsonl --tasks"
    for tasks in ("8", "1"):
        command = [sys.executable, "-m", "offboard.loadgen", "call", *flags.split(), tasks]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    records = list(read_trace(tmp_path / "trace.jsonl"))
    assert records[0]["sites"]["onboard"]["predicted_s"] is None
    assert records[8]["sites"]["onboard"]["predicted_s"] is not None
    assert (records[8]["i"], records[8]["sites"]["onboard"]["age"]) == (0, PROBE_EVERY)
    command = [
        sys.executable,
        "-m",
        "offboard.loadgen",
        "call",
        *flags.replace("memory.json", ".").split(),
        "1",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, "loadgen call: memory .: is a folder, not a plain file\n")
