"""Kinds whose size has several numbers: from the size function to the trace, the memory file and the rule."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest

from offboard.common.errors import BadValue, DataError
from offboard.common.tasks import SIZE_NUMBERS_MAX, Kind, Task, task
from offboard.loadgen.__main__ import main
from offboard.loadgen.replay.dataset_file import measured_tasks, read_dataset, write_dataset
from offboard.loadgen.replay.recorded_tasks import read_tasks
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.table import measured_rows
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.store import Store
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.predictors import LEAST_SQUARES, PARTS
from offboard.robot_client.records.record import Record
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner


@task("several_raw", size=lambda numbers: numbers)
def several_raw(numbers: Any) -> Any:
    return numbers


@task("several_render", size=lambda pixels, layers: (pixels, layers))
def render(pixels: float, layers: float) -> float:
    return pixels * layers


@task("several_worked", size=lambda pixels, layers: [pixels, layers], work=float)
def worked(pixels: float, layers: float) -> float:  # noqa: ARG001 - only the size needs them
    return layers * 100


def sized(size: Callable[..., Any]) -> Callable[[Any], Any]:
    """The size function of a kind that was not asked before."""
    kind = Kind("fresh", several_raw, size)
    return lambda given: kind.size_of((given,))


@pytest.mark.parametrize(
    ("given", "size"),
    [
        (3, 3.0),
        ((3,), 3.0),
        ([3], 3.0),
        ((640, 3), (640.0, 3.0)),
        ([640, 3], (640.0, 3.0)),
        (tuple(range(SIZE_NUMBERS_MAX)), tuple(map(float, range(SIZE_NUMBERS_MAX)))),
    ],
)
def test_a_size_is_a_number_or_a_tuple_of_several(given: Any, size: Any) -> None:
    """A tuple or list of one number is that number."""
    found = sized(lambda numbers: numbers)(given)
    assert (found, type(found)) == (size, type(size))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ((), "input size has 0 numbers; 1 to 8 are allowed"),
        ((1.0,) * 9, "input size has 9 numbers; 1 to 8 are allowed"),
        ((1.0, float("nan")), "input size nan is not a finite number >= 0"),
        ([1.0, -1.0], "input size -1.0 is not a finite number >= 0"),
        ((1.0, "wide"), "input size: ValueError: could not convert string to float: 'wide'"),
        ((1.0, (2.0, 3.0)), "input size: TypeError"),
    ],
)
def test_other_sizes_are_refused(given: Any, why: str) -> None:
    """One line names the task and says what is wrong."""
    with pytest.raises(BadValue) as raised:
        sized(lambda numbers: numbers)(given)
    assert str(raised.value).startswith(f"task fresh: {why}")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("first", "later"), [((1, 2), 3), (3, (1, 2)), ((1, 2), [1, 2, 3])])
def test_the_count_must_not_change(first: Any, later: Any) -> None:
    """The first size of a kind decides how many numbers all of them have; a refused size decides nothing."""
    size_of = sized(lambda numbers: numbers)
    with pytest.raises(BadValue):
        size_of((-1.0, 1.0, 1.0, 1.0))
    before = size_of(first)
    with pytest.raises(BadValue, match=r"task fresh: input size has \d numbers, but had \d before"):
        size_of(later)
    assert size_of(first) == before


Make = Callable[..., Offloader]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    """Makes robots: the cloud takes 0.1 s, onboard 0.05 s for each layer; pixels take no time."""
    made: list[Offloader] = []

    def answer(site: str) -> ScriptedRunner:
        def script(one: Task) -> Execution:
            _, layers = one.args
            seconds = 0.1 if site == CLOUD else 0.05 * layers
            return Execution(site, seconds, one.kind.function(*one.args), run_s=seconds, queue_s=0.0)

        return ScriptedRunner(site, script)

    def factory(predictor: str = LEAST_SQUARES, rule: str = "paper", **options: Any) -> Offloader:
        memories = Memories(
            lambda: predictors.make(predictor, 10),
            shared_work=predictor == PARTS,
            store=Store(tmp_path / "memory.json") if options.pop("kept", False) else None,
        )
        sites = [answer(ONBOARD), answer(CLOUD)]
        made.append(Offloader(sites, policy=policies.make(rule), memories=memories, **options))
        return made[-1]

    yield factory
    for offload in made:
        offload.close()


def ask(offload: Offloader, tasks: int, function: Callable[..., Any] = render) -> list[Record]:
    random, records = Random(1), []
    for _ in range(tasks):
        offload(function, random.uniform(1e5, 1e6), random.uniform(0.5, 4))
        assert offload.last is not None
        records.append(offload.last)
    return records


def test_the_rule_predicts_a_time_that_depends_on_the_second_number_only(make: Make) -> None:
    """After the warm-up, `paper` predicts both sites exactly, and always chooses the faster one."""
    records = ask(make(), 60)
    assert [record.decision.both for record in records[:11]] == [True] * 10 + [False]
    for record in records[10:]:
        assert isinstance(record.size, tuple)
        onboard_s = 0.05 * record.size[1]
        assert record.sites[ONBOARD].predicted_s == pytest.approx(onboard_s, rel=1e-6)
        assert record.sites[CLOUD].predicted_s == pytest.approx(0.1, rel=1e-6)
        assert record.decision.site == (CLOUD if onboard_s > 0.1 else ONBOARD)
    assert {record.decision.site for record in records[10:]} == {ONBOARD, CLOUD}


def test_parts_uses_the_work_or_the_first_number(make: Make) -> None:
    """The default predictor has one amount: the first number, or the work that is expected for it."""
    offload = make(PARTS, "greedy")
    for function, amount in ((render, (3e5, 2.0)), (worked, 200.0)):
        for _ in range(12):
            offload(function, 3e5, 2.0)
        assert offload.last is not None
        assert offload.last.amount == amount
        assert offload.last.size == (3e5, 2.0)
        assert offload.last.sites[ONBOARD].predicted_s == pytest.approx(0.1, rel=0.05)
    assert "size 3e+05 and 2" in offload.last.decision.reason


def test_a_batch_takes_items_of_several_numbers(make: Make) -> None:
    """It starts the item with the largest first number first, and returns all results in order."""
    seen: list[Any] = []
    offload = make(observers=[lambda record: seen.append(record.size)])
    items = [(float(pixels), 1.0) for pixels in range(1, 6)]
    assert offload.map(render, items, where=ONBOARD) == [pixels for pixels, _ in items]
    assert sorted(seen, reverse=True) == items[::-1]
    assert seen[0] == items[-1]


def test_a_trace_keeps_the_numbers_and_a_table_reads_them(make: Make, tmp_path: Path) -> None:
    """A line holds a list; a dataset that is written from the trace has the same numbers in columns."""
    path = tmp_path / "trace.jsonl"
    trace = Trace(path)
    records = ask(make(observers=[trace.write]), 12)
    trace.close()
    lines = list(read_trace(path))
    assert [tuple(line["size"]) for line in lines] == [record.size for record in records]
    assert not any("work" in line["features"] for line in lines)
    rows = measured_rows.read(path)
    measured = measured_tasks(read_tasks(path, None))
    assert rows.sizes() == [task.size for task in measured] != []
    write_dataset(tmp_path / "rows.csv", measured)
    assert (tmp_path / "rows.csv").read_text().startswith("size,")
    assert measured_rows.read(tmp_path / "rows.csv").sizes() == rows.sizes()
    assert [task.size for task in read_dataset(tmp_path / "rows.csv")] == rows.sizes()


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        ("size,size_3,onboard_s,cloud_s", "1,2,3,4", "a column 'size_3', but no column 'size_2'"),
        ("size,size_2,onboard_s,cloud_s", "1,,3,4", "size_2: '' is not a finite number from 0 to 1e+15"),
    ],
)
def test_a_number_of_a_size_cannot_be_left_out(tmp_path: Path, header: str, row: str, said: str) -> None:
    """Both readers of datasets name the line and the column."""
    path = tmp_path / "rows.csv"
    path.write_text(f"{header}\n{row}\n")
    for reader in (measured_rows.read, read_dataset):
        with pytest.raises(DataError, match=re.escape(said)):
            reader(path)


def test_a_trace_whose_sizes_differ_in_length_is_refused(make: Make, tmp_path: Path) -> None:
    """The line is named, and what the first one had."""
    path = tmp_path / "trace.jsonl"
    trace = Trace(path)
    ask(make(observers=[trace.write]), 3)
    trace.close()
    first, second, *_ = path.read_text().splitlines()
    path.write_text(f"{first}\n{json.dumps(json.loads(second) | {'size': 4.0})}\n")
    with pytest.raises(DataError, match=r"trace\.jsonl:2: size: 4\.0 has 1 numbers, but .* first row has 2"):
        measured_rows.read(path)


def test_tables_and_replays_show_all_numbers_and_the_first_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the time depends on the second number alone, only the prediction from all is right."""
    random, path = Random(3), tmp_path / "rows.csv"
    lines = ["size,size_2,onboard_s,cloud_s"]
    for _ in range(120):
        first, second = random.uniform(1, 9), random.uniform(0, 1)
        lines.append(f"{first},{second},{0.1 + second},{0.6}")
    path.write_text("\n".join(lines))
    assert main(["table", str(path), "--windows", "20,full", "--format", "json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    accuracy = {(one["predictor"], one["window"]): one["accuracy_percent"] for one in table["scores"]}
    assert accuracy["least-squares", "20"] == accuracy["least-squares", "full"] == 100.0
    assert accuracy["least-squares (first number)", "20"] < 80.0
    assert (
        main(["replay", str(path), "--policies", "paper,default,cloud", "--window", "20", "--format", "json"])
        == 0
    )
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    over = {one["policy"]: one["time_over_oracle"] for one in table["scores"]}
    assert list(over) == ["paper", "paper (first number)", "default", "cloud", "oracle"]
    assert over["paper"] == pytest.approx(1.0)
    assert over["paper (first number)"] > 1.05
    assert main(["report", str(path), "--out", str(tmp_path), "--window", "20"]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "least-squares (first number)" in page
    assert "The size is the first number of each." in page


def test_a_restart_is_warm(make: Make) -> None:
    """The memory file keeps all numbers of a size."""
    with make(kept=True) as offload:
        ask(offload, 30)
    with make(kept=True) as offload:
        (record,) = ask(offload, 1)
    assert isinstance(record.size, tuple)
    assert not record.decision.both
    assert record.sites[ONBOARD].predicted_s == pytest.approx(0.05 * record.size[1], rel=1e-6)


def test_the_expected_work_is_recalled_by_the_first_number(make: Make, tmp_path: Path) -> None:
    """Of several numbers, the memory file pairs the first one with the work of the result."""
    with make(PARTS, "greedy", kept=True) as offload:
        records = ask(offload, 12, worked)
    pairs = json.loads((tmp_path / "memory.json").read_bytes())["kinds"]["several_worked"]["worked"]
    assert pairs == [[pixels, 100 * layers] for pixels, layers in (record.size for record in records)]
    with make(PARTS, "greedy", kept=True) as offload:
        assert ask(offload, 1, worked)[0].amount is not None


def test_a_memory_of_another_count_is_not_recalled(make: Make, tmp_path: Path) -> None:
    """If the size function returns more numbers than it did, the kind starts cold."""
    with make(kept=True) as offload:
        ask(offload, 30)
    path = tmp_path / "memory.json"
    whole = json.loads(path.read_bytes())
    for site in whole["kinds"]["several_render"]["sites"].values():
        for one in site["observations"]:
            one["size"] = one["amount"] = one["size"][0]
    path.write_text(json.dumps(whole))
    with make(kept=True) as offload:
        assert ask(offload, 1)[0].decision.both
