"""Datasets with all their columns, and their replay next to that of the trace that they come from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import DataError
from offboard.loadgen.export.export import ExportConfig, run_export
from offboard.loadgen.replay.dataset_file import COLUMNS, measured_tasks, read_dataset, write_dataset
from offboard.loadgen.replay.recorded_tasks import RecordedTask, read_tasks
from offboard.loadgen.replay.replay import replay
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation.model.task_costs import find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.table.measured_rows import MORE_SIZES, read
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution, Packed, Sending
from tests.mazes import warm
from tests.recorded_rows import of_rows

warm()

WINDOW = 20
RUNS = {
    ONBOARD: Execution(ONBOARD, 1 / 3, 120.0, queue_s=0.001, run_s=0.3, network_s=0.0, cpu_s=0.1),
    CLOUD: Execution(
        CLOUD,
        1 / 7,
        120.0,
        queue_s=0.002,
        run_s=0.05,
        network_s=0.06,
        cpu_s=0.04,
        bytes_out=5000,
        bytes_in=70,
        packed=(
            Packed(0, "zstd", 9000, bytes=4000, seconds=0.0012),
            Packed(None, "pack", 9, bytes=8, seconds=0.0),
        ),
    ),
}
FULL = RecordedTask(
    2.5,
    RUNS,
    {ONBOARD: Condition(load=0.25, capacity=0.2), CLOUD: Condition(0.03, True, 4, 0.1, 0.5, 0.9, 0.05)},
    {CLOUD: Sending(9100, ((0, 9000), (2, 100)))},
    timeout_s=5.0,
)
BARE = RecordedTask(3.0, {site: Execution(site, 0.5) for site in (ONBOARD, CLOUD)})


def test_a_dataset_holds_all_that_a_replay_needs(tmp_path: Path) -> None:
    """Tasks are read back as they were, to the last digit; what is unknown stays unknown."""
    write_dataset(tmp_path / "d.csv", [FULL, BARE])
    assert (tmp_path / "d.csv").read_text().splitlines()[0] == ",".join(
        name for name in COLUMNS if name not in MORE_SIZES
    )
    full, bare = read_dataset(tmp_path / "d.csv")
    assert full == FULL
    assert bare == replace(BARE, conditions=bare.conditions, sendings=bare.sendings)
    assert all(bare.conditions[site] == Condition() for site in (ONBOARD, CLOUD))
    assert (bare.work, bare.sendings[CLOUD]) == (None, Sending(0))
    write_dataset(tmp_path / "again.csv", [full, bare])
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "d.csv").read_bytes()


def test_unknown_bytes_are_not_written_as_0(tmp_path: Path) -> None:
    """A file without known bytes has no columns of them."""
    write_dataset(tmp_path / "d.csv", [BARE])
    assert (tmp_path / "d.csv").read_text().splitlines()[0] == "size,onboard_s,cloud_s,timeout_s"


@pytest.mark.parametrize(("cells", "known"), [("50,7", (50, 7)), ("50,", (0, 0)), (",7", (0, 0))])
def test_half_of_the_bytes_are_none(tmp_path: Path, cells: str, known: tuple[int, int]) -> None:
    """If the bytes of one direction are unknown, those of both are; 0 stands for that."""
    header = "size,onboard_s,cloud_s,cloud_bytes_out,cloud_bytes_in"
    (tmp_path / "d.csv").write_text(f"{header}\n3,0.5,0.5,{cells}\n")
    (task,) = read_dataset(tmp_path / "d.csv")
    assert (task.runs[CLOUD].bytes_out, task.runs[CLOUD].bytes_in) == known


def test_sizes_and_times_are_enough(tmp_path: Path) -> None:
    """A dataset of an earlier version, with three columns, is read; columns without a meaning are ignored."""
    (tmp_path / "d.csv").write_text("size,onboard_s,cloud_s,weather\n3,0.5,0.5,fine\n")
    (task,) = read_dataset(tmp_path / "d.csv")
    assert (task.size, task.runs) == (3, BARE.runs)


@pytest.mark.parametrize(
    ("column", "cell", "allowed"),
    [
        ("onboard_s", "", "a finite number from 0 to 1e+15"),
        ("work", "much", "a finite number from 0 to 1e+15"),
        ("cloud_network_s", "-1", "a finite number from 0 to 1e+15"),
        ("cloud_network_s", "nan", "a finite number from 0 to 1e+15"),
        ("cloud_bytes_out", "1.5", "a whole number from 0 to 1e+15"),
        ("cloud_packed", "0:zstd:9", "a list of ARGUMENT:HOW:RAW_BYTES:BYTES:SECONDS with spaces between"),
        ("cloud_send_large", "1", "a list of ARGUMENT:BYTES with spaces between"),
        ("cloud.silent", "yes", "0 or 1"),
        ("cloud.queue", "0.5", "a whole number from 0 to 1e+15"),
        ("onboard.capacity", "0", "a number above 0, at most 1e+15"),
        ("timeout_s", "0", "a number above 0, at most 86400"),
    ],
)
def test_a_wrong_cell_is_named(tmp_path: Path, column: str, cell: str, allowed: str) -> None:
    """The error has one line and names file, line, column, value, and what is allowed."""
    path = tmp_path / "d.csv"
    write_dataset(path, [FULL, FULL])
    header, first, second = (line.split(",") for line in path.read_text().splitlines())
    second[header.index(column)] = cell
    path.write_text("\n".join(",".join(line) for line in (header, first, second)) + "\n")
    with pytest.raises(DataError) as raised:
        read_dataset(path)
    assert str(raised.value) == f"{path}:3: {column}: {cell!r} is not {allowed}"


def test_a_column_may_not_come_twice(tmp_path: Path) -> None:
    """Of two columns with one name, none is chosen silently."""
    (tmp_path / "d.csv").write_text("size,onboard_s,cloud_s,work,work\n3,0.5,0.5,1,2\n")
    with pytest.raises(DataError, match=r"d\.csv:1: header .* has the column 'work' twice"):
        read_dataset(tmp_path / "d.csv")


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trace of a simulated robot whose tasks all run on both sites while the round trip changes."""
    scenario = read_scenario(find_scenario("rtt-step")).changed(policy="default", measure_all=True)
    tasks = {
        robot: find_tasks(scenario.workload, scenario.seed, scenario.workload.tasks)
        for robot in scenario.robots()
    }
    path = tmp_path_factory.mktemp("run") / "trace.jsonl"
    written = Trace(path)
    simulate(scenario, tasks, trace=written)
    written.close()
    return path


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("policy", ["paper", "greedy", "probe:greedy", "hedge:probe:greedy", "default"])
def test_a_dataset_is_replayed_as_its_trace(trace: Path, tmp_path: Path, policy: str, feedback: str) -> None:
    """The same policy makes the same decisions of both, so every task takes equally long."""
    assert run_export(trace, ExportConfig(csv=tmp_path / "d.csv")) == 0
    found = [
        replay(tasks, policy, ReplayConfig(window=WINDOW), feedback=feedback)
        for tasks in (measured_tasks(read_tasks(trace, None)), read_dataset(tmp_path / "d.csv"))
    ]
    assert len(found[0].spent_s) == len(read(trace)) - WINDOW > 100
    for name in ("to_cloud", "both", "spent_s"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))


def test_the_columns_change_what_a_policy_decides(trace: Path, tmp_path: Path) -> None:
    """Where the round trip changes, the default does better with all columns than with times alone."""
    run_export(trace, ExportConfig(csv=tmp_path / "d.csv"))
    tasks = read_dataset(tmp_path / "d.csv")
    assert all(task.work is not None for task in tasks)
    bare = of_rows(read(tmp_path / "d.csv"))
    whole_s, bare_s = (
        replay(given, "default", ReplayConfig(window=WINDOW), feedback="chosen").spent_s.mean()
        for given in (tasks, bare)
    )
    assert whole_s < bare_s
