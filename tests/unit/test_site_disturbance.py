"""The disturbance between the sites: which records form a plan, and the figures, worked out by hand."""

import json
import math
from pathlib import Path

import pytest

from offboard.common.errors import CloudTimeout, DataError
from offboard.loadgen.play.run_files import TRACE
from offboard.loadgen.robot_files import alone_path
from offboard.loadgen.table.measurement_notes import ALONE, Change, Disturbance, measure
from offboard.robot_client.policies import Decision
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution

LATE = Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)


def onboard(seconds: float, cpu_s: float | None = None) -> Execution:
    return Execution(ONBOARD, seconds, queue_s=0.0, run_s=seconds, network_s=0.0, cpu_s=cpu_s)


def cloud(seconds: float, network_s: float = 0.01, cpu_s: float | None = None) -> Execution:
    run_s = seconds - network_s
    return Execution(CLOUD, seconds, queue_s=0.0, run_s=run_s, network_s=network_s, cpu_s=cpu_s)


def record(size: float, *executions: Execution) -> Record:
    decision = Decision(executions[0].site, "pinned by the caller", "pinned", both=len(executions) > 1)
    return Record(0, "0", "plan_path", size, {}, decision, executions, ONBOARD, 0.1)


def plan(
    size: float, o: float = 0.2, c: float = 0.1, both_o: float = 0.2, both_c: float = 0.1
) -> list[Record]:
    """The three records of one plan: onboard alone, in the cloud alone, on both sites at once."""
    return [
        record(size, onboard(o)),
        record(size, cloud(c)),
        record(size, onboard(both_o), cloud(both_c)),
    ]


def write(folder: Path, *records: Record) -> Path:
    trace = Trace(folder / ALONE)
    for one in records:
        trace.write(one)
    trace.close()
    return trace.path


def measured(folder: Path, *records: Record) -> Disturbance:
    found = measure(write(folder, *records))
    assert found is not None
    return found


def test_the_figures_of_three_plans_are_right(tmp_path: Path) -> None:
    """Medians of times and ratios equal those by hand; three ratios are too few for an interval."""
    found = measured(
        tmp_path,
        record(1.0, onboard(0.10, 0.02), cloud(0.06, 0.045, 0.01)),
        record(1.0, onboard(0.10, 0.02)),
        record(1.0, cloud(0.05, 0.03, 0.02)),
        record(2.0, onboard(0.20, 0.06)),
        record(2.0, cloud(0.10, 0.04, 0.03)),
        record(2.0, onboard(0.20, 0.20), cloud(0.15, 0.04, 0.11)),
        record(3.0, cloud(0.08, 0.02, 0.06)),
        record(3.0, onboard(0.60, 0.60), cloud(0.08, 0.03, 0.05)),
        record(3.0, onboard(0.40, 0.04)),
    )
    assert (found.plans, found.skipped) == (3, 0)
    # onboard: 0.10 / 0.10, 0.20 / 0.20, 0.60 / 0.40
    assert found.sites[ONBOARD].seconds == near(3, 0.20, 0.20, 1.0)
    # cloud: 0.06 / 0.05, 0.15 / 0.10, 0.08 / 0.08
    assert found.sites[CLOUD].seconds == near(3, 0.08, 0.08, 1.2)
    # its network: 0.045 / 0.03, 0.04 / 0.04, 0.03 / 0.02
    assert found.sites[CLOUD].network == near(3, 0.03, 0.04, 1.5)
    assert found.sites[ONBOARD].network is None
    # alone: 0.02 / 0.10, 0.06 / 0.20, 0.04 / 0.40; and 0.02 / 0.02, 0.03 / 0.06, 0.06 / 0.06
    assert found.sites[ONBOARD].cpu_share == pytest.approx(0.2)
    assert found.sites[CLOUD].cpu_share == pytest.approx(1.0)


def near(pairs: int, alone_s: float, beside_s: float, ratio: float, *ends: float) -> Change:
    """A change with these figures, within rounding; without `ends` it has no interval."""
    figures = (pytest.approx(figure) for figure in (alone_s, beside_s, ratio))
    return Change(pairs, *figures, *((pytest.approx(end) for end in ends) if ends else (None, None)))


def test_the_interval_of_eleven_plans_is_right(tmp_path: Path) -> None:
    """Of eleven ratios, the interval goes from the third smallest to the third largest.

    The median of a resample of eleven is one of the two smallest ratios with probability 0.7 %, one of the
    three smallest with probability 5.1 % (binomial, at least 6 of 11); 2.5 % lies between them.
    """
    ratios = [1.4, 1.1, 1.7, 1.2, 1.5, 1.3, 1.6, 2.1, 1.8, 2.0, 1.9]
    plans = [plan(n, o=0.5, both_o=0.5 * ratio) for n, ratio in enumerate(ratios)]
    found = measured(tmp_path, *(one for three in plans for one in three))
    assert found.sites[ONBOARD].seconds == near(11, 0.5, 0.8, 1.6, 1.3, 1.9)
    assert found.sites[CLOUD].seconds == near(11, 0.1, 0.1, 1.0, 1.0, 1.0)


def test_the_same_seed_gives_the_same_interval(tmp_path: Path) -> None:
    """The interval depends on the seed: the same seed gives the same one, other seeds give others."""
    plans = [plan(n, both_c=0.1 + 0.001 * n * n) for n in range(40)]
    path = write(tmp_path, *(one for three in plans for one in three))
    assert measure(path, seed=3) == measure(path, seed=3)
    assert len({str(measure(path, seed=seed)) for seed in range(8)}) > 1


def test_one_plan_is_enough(tmp_path: Path) -> None:
    """A single pair has a ratio, but no interval."""
    found = measured(tmp_path, *plan(1.0, c=0.1, both_c=0.125))
    assert found.sites[CLOUD].seconds == near(1, 0.1, 0.125, 1.25)
    assert found.sites[CLOUD].cpu_share is None


@pytest.mark.parametrize(
    ("between", "skipped"),
    [
        ([record(5.0, onboard(0.2))], 1),
        ([record(5.0, onboard(0.2)), record(5.0, onboard(0.2)), record(5.0, cloud(0.1))], 3),
        ([record(5.0, onboard(0.2)), record(5.0, LATE, onboard(0.2)), plan(5.0)[2]], 3),
        ([record(5.0, onboard(0.2)), record(5.0, cloud(0.1)), record(5.0, onboard(0.2), LATE)], 3),
        ([record(5.0, onboard(0.2)), record(5.0, cloud(0.1)), record(6.0, *plan(1.0)[2].executions)], 3),
        ([*plan(5.0)[:2], record(5.0, onboard(0.2), Execution("edge", 0.1, network_s=0.0, run_s=0.1))], 3),
        ([record(5.0, LATE)], 1),
    ],
    ids=["torn off", "twice onboard", "fell back", "late in the cloud", "other size", "other site", "late"],
)
def test_incomplete_plans_are_skipped_and_counted(
    tmp_path: Path, between: list[Record], skipped: int
) -> None:
    """Only three neighbouring records of one size, run in the three ways, form a plan; others are skipped."""
    found = measured(tmp_path, *plan(1.0), *between, *plan(2.0), *between)
    assert (found.plans, found.skipped) == (2, 2 * skipped)


def test_a_trace_without_a_complete_plan_has_no_disturbance(tmp_path: Path) -> None:
    """If the cloud never answered, there is no complete plan, and the result is None."""
    assert measure(write(tmp_path)) is None
    assert measure(write(tmp_path, *[record(1.0, onboard(0.2))] * 9)) is None


def test_a_trace_without_cpu_time_is_read(tmp_path: Path) -> None:
    """Older traces lack cpu_s: they give times, but no share of CPU time."""
    lines = [as_dict(one) for one in plan(1.0)]
    for line in lines:
        for one in line["executions"]:
            del one["cpu_s"]
    path = tmp_path / ALONE
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = measure(path)
    assert found is not None
    assert (found.plans, found.sites[ONBOARD].cpu_share) == (1, None)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"size": "big"}, "size: 'big' is not a number from 0 to 1e+15"),
        ({"size": True}, "size: True is not a number"),
        ({"executions": 3}, "executions: TypeError"),
        ({"executions": [{"site": ONBOARD}]}, "executions: KeyError('ok'); each needs site, seconds, ok"),
        ({"seconds": None}, "seconds of onboard: None is not a number from 1e-09 to 1e+15"),
        ({"seconds": 0}, "seconds of onboard: 0 is not a number from 1e-09"),
        ({"seconds": math.nan}, "seconds of onboard: nan is not a number"),
        ({"network_s": -1}, "network_s of onboard: -1 is not a number from 0"),
        ({"cpu_s": "x" * 99}, "cpu_s of onboard: '" + "x" * 59 + " is not a number"),
        ({"cpu_s": 0.1, "run_s": None}, "run_s of onboard: None is not a number"),
        ({"site": []}, "executions: TypeError"),
    ],
)
def test_a_wrong_value_is_an_error_with_its_line(
    tmp_path: Path, changed: dict[str, object], message: str
) -> None:
    """The error names file, line, field and value."""
    good, bad = as_dict(plan(1.0)[0]), as_dict(plan(1.0)[0])
    for name, value in changed.items():
        (bad if name in bad else bad["executions"][0])[name] = value
    path = tmp_path / ALONE
    path.write_text(json.dumps(good) + "\n" + json.dumps(bad) + "\n")
    with pytest.raises(DataError) as caught:
        measure(path)
    assert str(caught.value).startswith(f"{path}:2: {message}")


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    """If the file does not exist, the error names it."""
    with pytest.raises(DataError, match=r"trace\.alone\.jsonl: No such file"):
        measure(tmp_path / ALONE)


def test_it_is_printed_as_text_and_as_json(tmp_path: Path) -> None:
    """The text has one line for each figure, and JSON holds the same figures."""
    found = measured(
        tmp_path,
        record(1.0, onboard(0.2, 0.04)),
        record(1.0, cloud(0.1, 0.04, 0.06)),
        record(1.0, onboard(0.25, 0.05), cloud(0.12, 0.06, 0.06)),
    )
    assert found.lines() == [
        "Disturbance between the sites, from 1 plans that ran on each site alone and on both "
        "at once (0 records of incomplete plans were skipped):",
        "onboard, total time: 200 ms alone, 250 ms with both sites running, ratio 1.250",
        "onboard, alone: the task used the CPU for 20% of its run time",
        "cloud, total time: 100 ms alone, 120 ms with both sites running, ratio 1.200",
        "cloud, time outside the server: 40 ms alone, 60 ms with both sites running, ratio 1.500",
        "cloud, alone: the task used the CPU for 100% of its run time",
    ]
    found_json = json.loads(json.dumps(found.as_dict()))
    assert (found_json["plans"], found_json["skipped"]) == (1, 0)
    assert found_json["sites"]["onboard"]["seconds"] == {
        "pairs": 1,
        "alone_s": 0.2,
        "beside_s": 0.25,
        "ratio": pytest.approx(1.25),
        "ratio_low": None,
        "ratio_high": None,
    }
    assert found_json["sites"]["onboard"]["network"] is None
    assert found_json["sites"]["cloud"]["cpu_share"] == pytest.approx(1.0)


def test_the_robot_writes_the_file_that_is_read() -> None:
    """The file name here is the one that the robot uses."""
    assert alone_path(Path("out") / TRACE) == Path("out") / ALONE
