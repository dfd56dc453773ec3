"""Mistakes of users on the real command lines: one line that helps, never a traceback."""

import subprocess
import sys
from pathlib import Path

import pytest

YAML = "origin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
FILES = {
    "no-resolution.yaml": "image: map.pgm\n" + YAML,
    "text-image.yaml": "image: words.txt\nresolution: 0.1\n" + YAML,
    "words.txt": "not an image",
    "bad.jsonl": '{"v": 1}\nnonsense\n',
    "deep.jsonl": '{"v":1,"i":' + "[" * 50_000 + "\n",
    "deep/trace.jsonl": '{"v":1,"i":' + "[" * 50_000 + "\n",
    "deep/summary.json": "[" * 50_000,
    "text.csv": "size,onboard_s,cloud_s\n1,2,3\n1,two,3\n",
    "empty.csv": "",
    "empty.jsonl": "",
    "exits.py": "import sys\n\nsys.exit(3)\n",
    "exits.toml": 'name = "exits"\n[workload]\ntask = "exits:f"\nsizes = ["constant:1"]\n',
    "answers.jsonl": '{"v":1,"i":0,"id":"","due_s":0,"began_s":0,"ended_s":0,"error":"","answer":null}\n',
    "open.map": "type octile\nheight 3\nwidth 3\nmap\n...\n...\n...\n",
    "text-link.toml": 'name = "odd"\n[workload]\nmap = "open.map"\n[link]\ndelay_ms = "slow"\n',
    "open.toml": 'name = "open"\n[workload]\nmap = "open.map"\n',
    "alone.toml": 'name = "alone"\n[workload]\nmap = "open.map"\ntasks = 3\nalone = 4\n',
    "no-map.toml": 'name = "odd"\n[workload]\nmap = "none.yaml"\n',
    "camera.py": """from offboard.common.tasks import task


@task("bright", size=lambda frame: frame.size)
def bright(frame):
    return float(frame.mean())


def few(seed):
    yield "a frame"


def nothing(seed):
    return None
""",
    "inputs.toml": 'name = "odd"\n[workload]\nmap = "open.map"\ninputs = "camera:few"\n',
    "rows.csv": "size,onboard_s,cloud_s\n1,2,3\n2,3,4\n3,4,5\n",
    "nope.toml": """name = "nope"
[workload]
task = "camera:bright"

inputs = "camera:nope"
""",
    "half.toml": 'name = "half"\n[workload]\ntask = "camera"\ninputs = "camera:few"\n',
    "rate.toml": 'name = "rate"\n[workload]\nmap = "open.map"\njump = true\narrivals = "poisson"\n',
    "late.toml": """name = "late"
[workload]
task = "camera:bright"
inputs = "camera:few"
[[check]]
figure = "late_percent"
at_most = 1
""",
    "odd.toml": 'name = "odd"\n[workload]\nmap = "m.yaml"\ntaks = 3\n',
}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["loadgen", "drive"], "--map is missing"),
        (["loadgen", "call"], "--task is missing"),
        (["loadgen", "call", "--map", "open.map"], "unrecognized arguments: --map open.map"),
        (["loadgen", "drive", "--task", "m:f"], "unrecognized arguments: --task m:f"),
        (["loadgen", "drive", "--map", "none.yaml"], "none.yaml"),
        (
            ["loadgen", "call", "--task", "m:f", "--sizes", "constant:1"],
            "--task: 'm:f' is not MODULE:FUNCTION",
        ),
        (["loadgen", "drive", "--map", "open.map", "--sizes", "none.csv"], "--sizes: 'none.csv' is not"),
        (
            ["loadgen", "drive", "--map", "open.map", "--radius", "0", "--answers", "answers.jsonl"],
            "--answers: answers.jsonl holds 1 answers; going on after them needs --jump",
        ),
        (["loadgen", "drive", "--map", "no-resolution.yaml"], "no-resolution.yaml: resolution"),
        (["loadgen", "drive", "--map", "text-image.yaml"], "words.txt"),
        (
            ["loadgen", "drive", "--map", "open.map", "--radius", "9"],
            "no room for a robot of radius 9 m",
        ),
        (
            ["loadgen", "drive", "--map", "open.map", "--metrics", "127.0.0.1:99999"],
            "--metrics: '127.0.0.1:99999'",
        ),
        (
            ["loadgen", "drive", "--map", "open.map", "--policy", "paper", "--objective", "p95"],
            "--objective: p95 changes nothing with",
        ),
        (
            ["loadgen", "drive", "--map", "open.map", "--trace", "words.txt"],
            "words.txt: the file exists and is no",
        ),
        (["loadgen", "drive", "--map", "m.yaml", "--window", "0"], "--window: 0 is below 2"),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--policy", "x"],
            "'x' is not one of paper, paper-with-heartbeats, onboard, cloud",
        ),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--cloud", "tcp:/x"],
            "--cloud: 'tcp:/x' is not tcp://HOST:PORT",
        ),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--site", "edge"],
            "--site: 'edge' is not NAME=tcp://HOST:PORT or NAME=ws://HOST:PORT",
        ),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--trace", "t", "--alone", "3"],
            "--alone: 3 needs --cloud",
        ),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--cloud", "tcp://h:1", "--alone", "3"],
            "--alone: 3 needs --trace",
        ),
        (
            ["loadgen", "drive", "--map", "m.yaml", "--tasks", "3", "--alone", "4"],
            "--alone: 4 is above --tasks 3",
        ),
        (
            ["loadgen", "call", "--task", "camera:bright", "--sizes", "constant:1"],
            "--sizes: 'constant:1': task bright: input size: AttributeError: 'int' object "
            "has no attribute 'size'; use --inputs",
        ),
        (
            ["loadgen", "call", "--task", "camera:bright", "--inputs", "camera:few"],
            "--inputs: 'camera:few': task bright: input size: AttributeError: 'str' object has no attribute",
        ),
        (
            ["loadgen", "call", "--task", "camera:bright", "--inputs", "camera:none"],
            "camera has no function 'none'",
        ),
        (
            ["loadgen", "call", "--task", "camera:bright", "--inputs", "m:f"],
            "--inputs: 'm:f' is not MODULE:FUNCTION",
        ),
        (
            ["loadgen", "call", "--task", "camera:bright", "--inputs", "camera:nothing"],
            "returned NoneType, which is not",
        ),
        (["loadgen", "run", "inputs.toml"], "inputs.toml: workload.inputs: 'camera:few' needs workload.task"),
        (["loadgen", "run", "alone.toml"], "alone.toml: workload.alone: 4 is above workload.tasks 3"),
        (
            ["loadgen", "run", "nope.toml"],
            "nope.toml:5: workload.inputs: 'camera:nope' is not MODULE:FUNCTION with a function of the seed",
        ),
        (
            ["loadgen", "compare", "nope.toml", "half.toml"],
            "nope.toml:5: workload.inputs: 'camera:nope' is not MODULE:FUNCTION",
        ),
        (["loadgen", "run", "half.toml"], "half.toml:3: workload.task: 'camera' is not MODULE:FUNCTION"),
        (
            ["loadgen", "run", "rate.toml"],
            "rate.toml:5: workload.arrivals: poisson needs workload.rate, the tasks per second",
        ),
        (
            ["loadgen", "run", "late.toml"],
            "late.toml:6: check late_percent at most 1 %: cannot be computed without workload.deadline_ms",
        ),
        (["cloud_server", "--listen", "localhost"], "--listen: 'localhost'"),
        (["cloud_server", "--tasks", "no.such.module"], "'no.such.module' cannot be imported"),
        (["loadgen", "table", "none.csv"], "none.csv"),
        (["loadgen", "table", "text.csv"], "text.csv:3: onboard_s"),
        (["loadgen", "table", "empty.csv"], "empty.csv"),
        (["loadgen", "table", "bad.jsonl"], "bad.jsonl:1: no field"),
        (["loadgen", "table", "text.csv", "--windows", "0"], "--windows: '0'"),
        (
            ["loadgen", "table", "rows.csv", "--windows", "2", "--predictors", "no.Such"],
            "predictor 'no.Such': module 'no' cannot be imported: ModuleNotFoundError: ",
        ),
        (
            ["loadgen", "replay", "rows.csv", "--window", "2", "--policies", "camera.Such"],
            "policy 'camera.Such': module 'camera' has no class 'Such'",
        ),
        (
            ["loadgen", "drive", "--map", "open.map", "--obstacles", "0", "--policy", "camera.Such"],
            "policy 'camera.Such': module 'camera' has no class 'Such'",
        ),
        (["loadgen", "run", "odd.toml"], "odd.toml:4: unknown key 'taks'; did you mean 'tasks'?"),
        (["loadgen", "run", "no-map.toml"], "no-map.toml: workload.map: "),
        (["cloud_server", "--tasks", "json"], "--tasks: json registers no task"),
        (["cloud_server", "--config", "."], ".: Is a directory"),
        (["loadgen", "run", "none"], "unknown scenario 'none'; did you mean 'nonlinear'?"),
        (["loadgen", "run", "text-link.toml"], "text-link.toml: link.delay_ms: 'slow' is not a number"),
        (["loadgen", "run", "open.toml", "--out", "words.txt"], "--out: words.txt cannot be written to"),
        (["loadgen", "wan", "--delay-ms", "-1"], "--delay-ms: -1"),
        (["loadgen", "replay", "empty.jsonl"], "empty.jsonl: there is no task in this trace"),
        (["loadgen", "replay", "empty.jsonl", "--kind", "x"], "empty.jsonl: there is no x in this trace"),
        (["loadgen", "report", "empty.jsonl"], "empty.jsonl: no task was answered by both sites"),
        (["loadgen", "table", "empty.jsonl"], "empty.jsonl: no task was answered by both sites"),
        (
            ["loadgen", "export", "empty.jsonl", "--csv", "c.csv"],
            "empty.jsonl: no task was answered by both sites",
        ),
        (["cloud_server", "--tasks", "exits"], "task module 'exits' cannot be imported: SystemExit: 3"),
        (
            ["loadgen", "call", "--task", "exits:f", "--sizes", "constant:1"],
            "task module 'exits' cannot be imported: SystemExit: 3",
        ),
        (["loadgen", "run", "exits.toml"], "task module 'exits' cannot be imported: SystemExit: 3"),
        (
            ["loadgen", "drive", "--map", "open.map", "--obstacles", "0", "--policy", "exits.Such"],
            "policy 'exits.Such': module 'exits' cannot be imported: SystemExit: 3",
        ),
        (
            ["loadgen", "drive", "--map", "open.map", "--obstacles", "0", "--predictor", "exits.Such"],
            "predictor 'exits.Such': module 'exits' cannot be imported: SystemExit: 3",
        ),
        (["loadgen", "drive", "--map", "open.map", "--keys", "k"], "--keys: k needs --cloud"),
        (["loadgen", "drive", "--map", "open.map", "--rate", "5"], "--rate: 5 needs --arrivals"),
        (
            ["loadgen", "drive", "--map", "a.map", "--map", "open.map"],
            "--map is given twice, but takes one value",
        ),
        (["loadgen", "drive", "--map", "open.map", "--trace", "/dev/null"], "/dev/null: is a device"),
        (
            ["loadgen", "drive", "--map", "open.map", "--obstacles", "0", "--memory", "/dev/null"],
            "memory /dev/null: is a device",
        ),
        (["loadgen", "table", "deep.jsonl"], "deep.jsonl:1: not a JSON line: maximum recursion depth"),
        (["loadgen", "replay", "deep.jsonl"], "deep.jsonl:1: not a JSON line: maximum recursion depth"),
        (["loadgen", "claims", "deep.jsonl"], "deep.jsonl:1: not a JSON line: maximum recursion depth"),
        (["loadgen", "report", "deep"], "maximum recursion depth"),
        (["loadgen", "export", "deep.jsonl", "--csv", "f"], "deep.jsonl:1: not a JSON line: maximum recurs"),
        (["loadgen", "fleet", "--load", "inf"], "--load: inf is above 1000, the maximum"),
        (["loadgen", "fleet", "--rounds", "inf"], "--rounds: inf is not a finite number"),
        (["loadgen", "fleet", "--start-s", "inf"], "--start-s: inf is not a finite number"),
        (["loadgen", "wan", "--to", "nowhere"], "--to: 'nowhere' is not HOST:PORT"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(command: list[str], message: str, tmp_path: Path) -> None:
    """The error is one line on stderr that names the mistake, without a traceback."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
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
    """Without its optional libraries a command says what to install, with exit code 2."""
    probe = (
        "import runpy, sys\n"
        "sys.modules['uvicorn'] = sys.modules['fastapi'] = None\n"
        f"sys.argv = {command!r}\n"
        "runpy.run_module(f'offboard.{sys.argv[0]}', run_name='__main__')\n"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr.endswith(f"run pip install '.[{extra}]' in a checkout of Offboard\n")
    assert len(done.stderr.splitlines()) == 1


def test_a_reader_that_stops_early_is_not_an_error(tmp_path: Path) -> None:
    """`loadgen table ... | head -1` ends without a message."""
    rows = "\n".join(f"{n},{n},1" for n in range(1, 40))
    (tmp_path / "rows.csv").write_text(f"size,onboard_s,cloud_s\n{rows}\n")
    table = (
        f"{sys.executable} -m offboard.loadgen table rows.csv --windows {','.join(map(str, range(2, 35)))}"
    )
    done = subprocess.run(
        f"{table} --format json | true", shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=30
    )
    assert done.stderr == ""
