"""`loadgen drive` and `call` against a real server: answers, references and open arrivals."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.robot import answers
from offboard.loadgen.robot_files import read_trace, reference_path
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.policies import PINNED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROOT = Path(__file__).parents[2]
MAP = ("drive", "--map", str(ROOT / "maps/depot.yaml"), "--resolution", "0.05", "--jump")
POISSON = ("--arrivals", "poisson", "--rate", "60")
KILL_AFTER = 40  # answers
WAIT_S = 60.0


def command(*flags: object) -> list[str]:
    return [sys.executable, "-m", "offboard.loadgen", *map(str, flags)]


def robot(*flags: object, code: int = 0) -> str:
    """Run the robot to its end; return its output."""
    done = subprocess.run(command(*flags), capture_output=True, text=True, timeout=WAIT_S, cwd=ROOT)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout


def by_number(path: Path) -> dict[int, Any]:
    """The answer to each task, which must have one line."""
    found = list(answers.read(path))
    assert len({line["i"] for line in found}) == len(found)
    return {line["i"]: line["answer"] for line in found}


@pytest.mark.parametrize("arrivals", [(), POISSON], ids=["closed", "open"])
def test_a_killed_run_continues_after_its_answers(
    testbed: Callable[..., LocalTestbed], tmp_path: Path, arrivals: tuple[str, ...]
) -> None:
    """After kill -9 and a restart, each task has one answer, the same as in a run that was not killed."""
    bed = testbed({"tasks": "offboard.common.planning.planner"})
    flags = [*MAP, *arrivals, "--cloud", bed.endpoint, "--tasks", 150, "--sizes", "uniform:0:3", "--seed", 7]
    robot(*flags, "--answers", tmp_path / "whole.jsonl")
    path, kept = tmp_path / "answers.jsonl", tmp_path / "trace.jsonl"
    killed = subprocess.Popen(
        command(*flags, "--answers", path, "--trace", kept), stdout=subprocess.DEVNULL, cwd=ROOT
    )
    try:
        until = time.monotonic() + WAIT_S
        while not path.exists() or path.read_bytes().count(b"\n") < KILL_AFTER:
            assert killed.poll() is None
            assert time.monotonic() < until
            time.sleep(0.005)
    finally:
        killed.kill()
        killed.wait()
    with path.open("ab") as file:
        file.write(b'{"v":1,"i":')  # a torn line, as a crash of the computer may leave it
    before = {line["i"] for line in answers.read(path)}
    assert KILL_AFTER <= len(before) < 150
    ran_before = len(list(read_trace(kept)))
    said = robot(*flags, "--answers", path, "--trace", kept)
    assert f"{len(before)} of 150 tasks had their answer before" in said
    assert f"{150 - len(before)} tasks answered" in said
    assert len(list(read_trace(kept))) == ran_before + 150 - len(before)
    assert by_number(path) == by_number(tmp_path / "whole.jsonl")
    assert by_number(path).keys() == set(range(150))
    lines = list(answers.read(path))[len(before) :]
    assert min(line["due_s"] for line in lines) == pytest.approx(0, abs=1e-3)
    if arrivals:
        assert "started over 10 ms after they were due: " in said
        assert all(line["due_s"] <= line["began_s"] <= line["ended_s"] for line in lines)


def test_an_interrupted_run_keeps_its_answers(testbed: Callable[..., LocalTestbed], tmp_path: Path) -> None:
    """After Ctrl-C, trace and answers have the same tasks, and none that was in flight."""
    bed = testbed(delay_ms=40.0)
    path, kept = tmp_path / "answers.jsonl", tmp_path / "trace.jsonl"
    flags = [
        "call",
        "--task",
        "tests.probes:zeros",
        "--sizes",
        "constant:9",
        "--tasks",
        10_000,
        "--policy",
        CLOUD,
    ]
    flags += ["--arrivals", "constant", "--rate", 100, "--cloud", bed.endpoint]
    run = subprocess.Popen(
        command(*flags, "--answers", path, "--trace", kept),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    until = time.monotonic() + WAIT_S
    while not path.exists() or path.read_bytes().count(b"\n") < KILL_AFTER:
        assert run.poll() is None
        assert time.monotonic() < until
        time.sleep(0.005)
    run.send_signal(signal.SIGINT)
    assert run.communicate(timeout=WAIT_S)[1] == "loadgen call: interrupted\n"
    assert run.returncode == 130
    lines, records = list(answers.read(path)), list(read_trace(kept))
    assert len(lines) >= KILL_AFTER
    assert {line["id"] for line in lines} <= {record["id"] for record in records}
    assert len(records) <= len(lines) + 16  # tasks that ended at the instant of the signal
    assert all(record["used"] == CLOUD for record in records)


def test_references_are_measured_on_each_site_alone(
    testbed: Callable[..., LocalTestbed], tmp_path: Path
) -> None:
    """Every fifth plan runs again onboard and in the cloud; the trace of the run has only the run."""
    bed = testbed({"tasks": "offboard.common.planning.planner"}, delay_ms=5.0)
    kept = tmp_path / "trace.jsonl"
    flags = ["--cloud", bed.endpoint, "--tasks", 20, "--window", 4, "--trace", kept, "--reference", 5]
    robot(*MAP, *flags, "--answers", tmp_path / "a.jsonl")
    records = {record["id"]: record for record in read_trace(kept)}
    assert len(records) == 20
    assert PINNED not in {record["decision"]["policy"] for record in records.values()}
    asked = {line["i"]: line for line in answers.read(tmp_path / "a.jsonl")}
    lines = read_lines(reference_path(kept))
    assert [line["i"] for line in lines] == [4, 9, 14, 19]
    for line in lines:
        record = records[asked[line["i"]]["id"]]
        assert (line["chosen"], line["used"]) == (record["decision"]["site"], record["used"])
        assert line["both"] == record["decision"]["both"]
        assert line["waited_s"] == asked[line["i"]]["ended_s"] - asked[line["i"]]["due_s"]
        assert line["sites"].keys() == {ONBOARD, CLOUD}
        assert all(one["ok"] and not one["censored"] for one in line["sites"].values())
        assert line["sites"][CLOUD]["seconds"] > 0.010  # the link alone


def test_a_task_is_called_with_its_sizes(testbed: Callable[..., LocalTestbed], tmp_path: Path) -> None:
    """Sizes come from a CSV file, calls at a Poisson rate; both sites answer the same, and failures count."""
    bed = testbed()
    (tmp_path / "sizes.csv").write_text(
        "size\n1000\n2500.7\n1e15\n"
    )  # no computer has the memory for the last one
    flags = [
        "call",
        "--task",
        "tests.probes:zeros",
        "--sizes",
        tmp_path / "sizes.csv",
        "--tasks",
        30,
        *POISSON,
    ]
    found = {}
    for policy in (ONBOARD, CLOUD):
        path = tmp_path / f"{policy}.jsonl"
        kept = tmp_path / f"{policy}.trace.jsonl"
        to = ["--cloud", bed.endpoint, "--policy", policy, "--answers", path, "--trace", kept]
        said = robot(*flags, *to)
        assert "20 tasks answered; 10 failed\n" in said
        lines = {line["i"]: line for line in answers.read(path)}
        assert lines.keys() == set(range(30))
        for i, line in lines.items():
            assert (line["error"] is None) == (i % 3 != 2)
            assert (line["error"] or "TaskFailed: MemoryError").startswith("TaskFailed: ")
        records = {record["id"]: record for record in read_trace(kept)}
        sizes = [records[lines[i]["id"]]["size"] for i in range(30)]
        assert sizes == [1000, 2500, 1e15] * 10
        assert {record["executions"][0]["site"] for record in records.values()} == {policy}
        found[policy] = [(line["due_s"], line["answer"]) for _, line in sorted(lines.items())]
    assert found[ONBOARD] == found[CLOUD]
    assert len({answer["sha256"] for _, answer in found[CLOUD] if answer}) == 2


@pytest.mark.parametrize("arrivals", [(), POISSON], ids=["closed", "open"])
def test_a_task_is_called_with_inputs(
    testbed: Callable[..., LocalTestbed], tmp_path: Path, arrivals: tuple[str, ...]
) -> None:
    """Frames of a seed have the same answers on both sites, and another seed has others."""
    bed = testbed({"tasks": "tests.frames"})
    flags = ["call", "--task", "tests.frames:copied", "--inputs", "tests.frames:frames", "--tasks", 12]
    found = {}
    for policy, seed in ((ONBOARD, 1), (CLOUD, 1), (CLOUD, 2)):
        path, kept = tmp_path / f"{policy}{seed}.jsonl", tmp_path / f"{policy}{seed}.trace.jsonl"
        to = ["--cloud", bed.endpoint, "--policy", policy, "--seed", seed, "--answers", path]
        assert "12 tasks answered\n" in robot(*flags, *arrivals, *to, "--trace", kept)
        found[policy, seed] = by_number(path)
        records = list(read_trace(kept))
        assert {record["executions"][0]["site"] for record in records} == {policy}
        assert {record["size"] for record in records} == {480 * 640}
    assert found[ONBOARD, 1] == found[CLOUD, 1] != found[CLOUD, 2]


def test_inputs_can_be_measured_and_referenced(testbed: Callable[..., LocalTestbed], tmp_path: Path) -> None:
    """--measure, --reference and --alone work with inputs as with sizes."""
    bed = testbed({"tasks": "tests.frames"})
    kept = tmp_path / "trace.jsonl"
    flags = ["--task", "tests.frames:brightness", "--inputs", "tests.frames:frames", "--tasks", 8]
    measuring = ["--measure", 3, "--reference", 4, "--alone", 2]
    said = robot("call", *flags, *measuring, "--cloud", bed.endpoint, "--trace", kept)
    assert "8 tasks answered" in said
    assert "run on each site alone and on both at once: 2 of 2 tasks" in said
    assert [line["i"] for line in read_lines(reference_path(kept))] == [3, 7]


@pytest.mark.parametrize(
    ("inputs", "code", "said"),
    [
        ("broken", 1, "--inputs: 'tests.frames:broken' failed at input 2: OSError: no camera"),
        ("with_gain", 2, "--inputs: 'tests.frames:with_gain' gave 3 inputs, but --tasks and --alone need 5"),
    ],
)
def test_inputs_that_end_early_end_the_run(inputs: str, code: int, said: str) -> None:
    """One line says what happened; the tasks before it were answered."""
    flags = ["--task", "tests.frames:brightness", "--inputs", f"tests.frames:{inputs}", "--tasks", 5]
    done = subprocess.run(
        command("call", *flags), capture_output=True, text=True, timeout=WAIT_S, cwd=ROOT, check=False
    )
    assert done.returncode == code, done.stderr
    assert done.stderr == f"loadgen call: {said}\n"
