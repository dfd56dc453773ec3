"""`loadgen run demo`, shortened: a real map, three processes, and a robot with a CPU quota."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.loadgen.play import demo
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

ROOT = Path(__file__).parents[2]
MARK = f"OFFBOARD_TEST_MARK={os.getpid()}"


def loadgen(*args: str | Path) -> list[str]:
    return [sys.executable, "-m", "offboard.loadgen", *map(str, args)]


def marked_processes() -> dict[int, str]:
    """Process ids and command lines of all processes with the mark of this test in their environment."""
    left = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if MARK.encode() in (process / "environ").read_bytes():
                command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                left[int(process.name)] = command
        except OSError:
            continue
    return left


@contextmanager
def running_demo(out: Path) -> Iterator[subprocess.Popen[str]]:
    """`loadgen run demo`, from when its first tasks are answered."""
    name, value = MARK.split("=")
    host = subprocess.Popen(
        loadgen("run", "demo", "--out", out),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {name: value},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert host.stderr is not None
    trace, until = out / "trace.jsonl", time.monotonic() + 90
    try:
        while not trace.exists() or trace.read_bytes().count(b"\n") < 5:
            assert host.poll() is None
            assert time.monotonic() < until, "no task was answered"
            time.sleep(0.1)
        yield host
    finally:
        host.kill()
        host.wait()
        host.stderr.close()


def test_a_scenario_can_be_played_to_its_end(tmp_path: Path) -> None:
    """Both sites answer every plan, the map is uploaded before the first task, and the quota is in force."""
    done = subprocess.run(
        loadgen("run", "demo", "--tasks", "24", "--measure", "both", "--out", tmp_path),
        capture_output=True,
        text=True,
        timeout=150,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "quota: 0.2 CPU over " in done.stdout
    assert "24 tasks answered" in done.stdout
    records = list(read_trace(tmp_path / "trace.jsonl"))
    assert [record["i"] for record in records] == list(range(24))
    assert all(record["decision"]["both"] for record in records)
    assert all(one["ok"] for record in records for one in record["executions"])
    assert all(one["bytes_out"] < 100_000 for record in records for one in record["executions"])


def test_the_demo_ends_in_three_sentences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At its start it names the address of its page; at its end it compares both runs of the same plans."""
    whole = read_scenario(find_scenario("demo"))
    events = tuple(replace(event, at_task=at) for event, at in zip(whole.events, (10, 14), strict=True))
    short = replace(whole.changed(tasks=24), events=events, robot=replace(whole.robot, window=4))
    monkeypatch.setattr(demo, "read_scenario", lambda _: short)
    assert demo.play_demo(tmp_path) == 0
    first, *between, compared, result, next_step = capsys.readouterr().out.splitlines()
    assert [line for line in between if line.startswith("event: ")] == [
        "event: link outage = true",
        "event: link outage = false",
    ] * 2
    assert re.fullmatch(r"live page: http://127\.0\.0\.1:\d+/live", first)
    assert "the same 24 plans, once with Offboard and once with the published rule" in compared
    assert compared.endswith("30 ms away, and a link that was silent from plan 10 to plan 14.")
    assert re.match(r"Result: a plan took [\d.]+ ms in the mean with Offboard and [\d.]+ m?s with", result)
    slowest = [
        max(one["waited_s"] for one in read_trace(folder / "trace.jsonl"))
        for folder in (tmp_path, tmp_path / "paper")
    ]
    said = re.search(r"the slowest one ([\d.]+) (m?s) and ([\d.]+) (m?s); Offboard sent", result)
    assert said is not None
    for seconds, number, unit in zip(slowest, said.groups()[::2], said.groups()[1::2], strict=True):
        assert float(number) * (1e-3 if unit == "ms" else 1) == pytest.approx(seconds, rel=0.3, abs=0.02)
    assert f"`loadgen watch {tmp_path}`" in next_step
    assert f"{tmp_path / 'plan.png'} is a picture of the last plan" in next_step
    runs = [list(read_trace(folder / "trace.jsonl")) for folder in (tmp_path, tmp_path / "paper")]
    assert [one["size"] for one in runs[0]] == [one["size"] for one in runs[1]]
    policies = [{one["decision"]["policy"] for one in run} for run in runs]
    assert policies == [{"default"}, {"paper"}]


def test_the_same_seed_gives_the_same_tasks(tmp_path: Path) -> None:
    """Two runs with the same seed ask for plans of the same sizes."""
    sizes = []
    for name in ("a", "b"):
        out = tmp_path / name
        command = loadgen("run", "demo", "--tasks", "6", "--seed", "7", "--out", out)
        done = subprocess.run(command, capture_output=True, text=True, timeout=150, cwd=ROOT)
        assert done.returncode == 0, done.stdout + done.stderr
        sizes.append([record["size"] for record in read_trace(out / "trace.jsonl")])
    assert sizes[0] == sizes[1]
    assert len(set(sizes[0])) > 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    """After Ctrl-C or SIGTERM: exit code 130 or 143, no process is left, every line of the trace is whole."""
    with running_demo(tmp_path) as host:
        host.send_signal(number)
        assert host.wait(30) == 128 + number
    assert marked_processes() == {}
    assert len(list(read_trace(tmp_path / "trace.jsonl"))) >= 5


def test_a_killed_robot_fails_the_run(tmp_path: Path) -> None:
    """After kill -9 of the robot: exit code 1, one line that says why, and no process is left."""
    with running_demo(tmp_path) as host:
        (robot,) = (pid for pid, command in marked_processes().items() if " drive " in command)
        os.kill(robot, signal.SIGKILL)
        assert host.wait(30) == 1
        assert host.stderr.read() == "loadgen run: robot was ended by signal 9\n"
    assert marked_processes() == {}
