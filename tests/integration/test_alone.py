"""CPU time of executions, and plans that are measured on each site alone, with real processes."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.table.measurement_notes import measure
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import PINNED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.probes import burn, nap

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROOT = Path(__file__).parents[2]
BURNT_S = 0.3
NAP_S = 0.5
BURNS = 3
CPU_TOLERANCE_S = 0.03  # of the threads that send and receive, and the resolution of the clock
SCENARIO = f"""
name = "small"
seed = 3
[workload]
map = "{ROOT}/maps/depot.yaml"
resolution = 0.05
tasks = 6
alone = 6
[robot]
cpus = 0.5
[link]
delay_ms = 3
"""


def only(offload: Offloader) -> Execution:
    assert offload.last is not None
    (execution,) = offload.last.executions
    assert execution.ok, execution.error
    assert execution.cpu_s is not None
    assert execution.run_s is not None
    return execution


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_cpu_time_distinguishes_computing_from_waiting(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader], executor: str
) -> None:
    """The CPU time of a busy task is what it burnt, and its run time without waits; that of a nap is 0.

    The run time is compared in the best of a few runs, because a virtual machine may stand still unnoticed.
    """
    offload = connect(testbed({"executor": executor}))
    for site in (ONBOARD, CLOUD):
        rests = []
        for _ in range(BURNS):
            burnt_s, waited_s = offload(burn, BURNT_S, where=site)
            one = only(offload)
            said = f"{site}: {one.cpu_s:.4f} s of CPU in {one.run_s:.4f} s, {waited_s:.4f} s of them waiting"
            print(f"{said}; {burnt_s:.4f} s burnt, +-{CPU_TOLERANCE_S} s")
            assert one.cpu_s == pytest.approx(burnt_s, abs=CPU_TOLERANCE_S)
            rests.append(abs(one.run_s - waited_s - one.cpu_s))
        assert min(rests) <= CPU_TOLERANCE_S, rests
        offload(nap, NAP_S, where=site)
        one = only(offload)
        print(f"{site}: {one.cpu_s:.4f} s of CPU in {one.run_s:.4f} s asleep, +-{CPU_TOLERANCE_S} s")
        assert one.cpu_s == pytest.approx(0, abs=CPU_TOLERANCE_S)


def test_a_scenario_measures_plans_alone(tmp_path: Path) -> None:
    """`alone = 6` writes 18 records to a new trace of their own; the trace of the run has only the run."""
    scenario, out = tmp_path / "small.toml", tmp_path / "out"
    scenario.write_text(SCENARIO)
    out.mkdir()
    (out / "trace.alone.jsonl").write_text("{}\n")
    done = subprocess.run(
        [sys.executable, "-m", "offboard.loadgen", "run", scenario, "--out", out],
        capture_output=True,
        text=True,
        timeout=100,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "6 tasks answered" in done.stdout
    assert "18/18 size" in done.stdout
    assert "run on each site alone and on both at once: 6 of 6 plans\n" in done.stdout
    assert f"written: {out / 'trace.alone.jsonl'}\n" in done.stdout
    run, alone = list(read_trace(out / "trace.jsonl")), list(read_trace(out / "trace.alone.jsonl"))
    assert [record["i"] for record in run] == list(range(6))
    assert PINNED not in [record["decision"]["policy"] for record in run]
    assert [record["i"] for record in alone] == list(range(18))
    assert {record["decision"]["policy"] for record in alone} == {PINNED}
    found = measure(out / "trace.alone.jsonl")
    assert found is not None
    print("\n".join(found.lines()))
    assert (found.plans, found.skipped) == (6, 0)
    for record in run + alone:
        for one in (run for run in record["executions"] if run["ok"]):  # a warm-up waits for one of two
            assert 0 < one["cpu_s"] <= one["seconds"] + CPU_TOLERANCE_S


def test_an_absent_cloud_is_a_warning(tmp_path: Path) -> None:
    """The exit code is 0; the measurement counts the plans that the cloud did not answer."""
    trace, nowhere = tmp_path / "t.jsonl", "tcp://127.0.0.1:9"
    flags = ["drive", "--map", ROOT / "maps/depot.yaml", "--tasks", "2", "--alone", "2"]
    flags += ["--cloud", nowhere, "--connect", "0.1", "--trace", trace]
    for runs in (1, 2):
        done = subprocess.run(
            [sys.executable, "-m", "offboard.loadgen", *map(str, flags)],
            capture_output=True,
            text=True,
            timeout=50,
            cwd=ROOT,
        )
        assert done.returncode == 0, done.stderr
        missing = "; the cloud did not answer for the others"
        assert done.stdout.endswith(f"run on each site alone and on both at once: 0 of 2 plans{missing}\n")
        assert f"measuring without cloud: no answer from {nowhere} yet; tasks run onboard" in done.stderr
        assert len(list(read_trace(trace))) == 2 * runs
        assert len(list(read_trace(tmp_path / "t.alone.jsonl"))) == 6 * runs
    assert measure(tmp_path / "t.alone.jsonl") is None
