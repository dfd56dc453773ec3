"""Measuring the applications: figures from hand-made runs, the files, and the exit codes."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import applications
from benchmarks.application_runs import Planned
from benchmarks.application_tables import (
    POLICIES,
    Known,
    Run,
    faults,
    in_words,
    lines,
    response_times,
    table,
    tasks_csv,
    worst_tasks,
)
from offboard.loadgen.scenario.outcome import Answered, Outcome

TIMES_MS = {
    "paper": (100, 200, 300, 400),
    "default": (110, 90, 160, 240),
    "onboard": (100, 80, 300, 320),
    "cloud": (120, 140, 150, 190),
}
SENT = {
    "paper": ("onboard",) * 4,
    "default": ("onboard", "onboard", "cloud", "cloud"),
    "onboard": ("onboard",) * 4,
    "cloud": ("cloud",) * 4,
}


def answered(i: int, time_ms: float, site: str, **more: Any) -> Answered:
    """A task that became due after `i` seconds; Offboard itself added 2 ms."""
    return Answered(
        i=i,
        robot="robot",
        due_s=float(i),
        ended_s=i + time_ms / 1e3,
        error=None,
        answer=None,
        chosen=site,
        both=False,
        sites=(site,),
        overhead_s=0.002,
        **more,
    )


def made(policy: str, *, seed: int = 1, scenario: str = "apriltags-calm", lost: int | None = None) -> Run:
    """A run without the answer to task `lost`. Its times are those of its policy, and 15 ms more a seed."""
    times = zip(TIMES_MS[policy], SENT[policy], strict=True)
    tasks = [
        answered(i, time_ms + 15 * (seed - 1), site) for i, (time_ms, site) in enumerate(times) if i != lost
    ]
    known = {
        one.i: Known(
            size=10.0 * one.i,
            work=None,
            site=one.chosen,
            reason=f"because of {one.i}",
            predicted_s={"onboard": 0.1, "cloud": None},
        )
        for one in tasks
    }
    outcome = Outcome(asked={"robot": len(TIMES_MS[policy])}, answered=tasks)
    return Run(scenario, seed, policy, outcome, known)


RUNS = [made(policy) for policy in POLICIES]


def test_the_oracle_takes_the_faster_constant_run_of_each_task() -> None:
    """It is never slower than either of them."""
    times = response_times(RUNS)
    assert times["oracle"] == pytest.approx([100, 80, 150, 190])
    assert (times["oracle"] <= times["onboard"]).all()
    assert (times["oracle"] <= times["cloud"]).all()


def test_the_oracle_needs_one_of_the_two_answers() -> None:
    """If one constant run lost a task, the oracle takes the other one."""
    runs = [made(policy, lost=1 if policy == "onboard" else None) for policy in POLICIES]
    assert response_times(runs)["oracle"] == pytest.approx([100, 140, 150, 190])


def test_the_figures_of_a_line_are_those_computed_by_hand() -> None:
    """Mean, P95, share of the cloud, overhead, and the mean over that of the better constant policy."""
    by_policy = {line.policy: line for line in lines(RUNS)}
    assert list(by_policy) == [*POLICIES, "oracle"]
    mine = by_policy["default"]
    assert mine.mean_ms.value == pytest.approx(150)  # (110 + 90 + 160 + 240) / 4
    assert mine.p95_ms == pytest.approx(240)
    assert mine.cloud_percent == pytest.approx(50)
    assert mine.overhead_ms == pytest.approx(2)
    assert mine.overhead_percent == pytest.approx(100 * 2 / 150)
    assert mine.over_constant.value == pytest.approx(1.0)  # the cloud needs (120 + 140 + 150 + 190) / 4 = 150
    assert by_policy["oracle"].mean_ms.value == pytest.approx(130)
    assert by_policy["oracle"].cloud_percent == pytest.approx(50)
    assert by_policy["oracle"].overhead_ms is None
    wanted = "| apriltags-calm | default | 150.0 | 240.0 | 50 | 2.00 | 1.33 | 1.00 |"
    assert table(RUNS).splitlines()[2] == wanted
    (said,) = in_words(RUNS)
    assert said.startswith("apriltags-calm: default took 1.00")
    assert said.endswith("of the time of the better constant (cloud).")


def test_several_seeds_give_intervals_around_the_mean() -> None:
    """The interval is that of the tasks of all seeds, and contains the mean."""
    runs = [made(policy, seed=seed) for seed in (1, 2, 3) for policy in POLICIES]
    mean = next(line.mean_ms for line in lines(runs) if line.policy == "default")
    assert mean.value == pytest.approx(165)  # 150, 165 and 180
    assert mean.interval is not None
    low, high = mean.interval
    assert 100 < low < 165 < high < 230
    assert f"| 165.0 [{low:.1f}, {high:.1f}] |" in table(runs)


def test_every_task_is_a_line_of_the_csv_file() -> None:
    """A line holds the times under all policies, and what `default` chose, why, and what it predicted."""
    runs = RUNS + [made(policy, scenario="apriltags-busy") for policy in POLICIES]
    rows = list(csv.DictReader(io.StringIO(tasks_csv(runs))))
    assert [(row["scenario"], row["i"]) for row in rows] == [
        (scenario, str(i)) for scenario in ("apriltags-calm", "apriltags-busy") for i in range(4)
    ]
    assert list(rows[2].values()) == [
        *("apriltags-calm", "1", "2", "20.0", ""),
        *("300.000", "150.000", "300.000", "160.000"),
        *("cloud", "because of 2", "100.000", ""),
    ]


def test_the_worst_tasks_come_first_with_their_reason() -> None:
    """A task counts if `default` took longer than the faster constant run."""
    worst = worst_tasks(RUNS)
    assert [line.partition(":")[0].rpartition(" ")[2] for line in worst] == ["3", "2", "1", "0"]
    assert "lost 50 ms (default 240, onboard 320, cloud 190); chose cloud: because of 3" in worst[0]


def test_answers_that_are_not_verified_are_named() -> None:
    """Each of them is in one list, with its scenario, seed, policy and task."""
    tasks = [
        answered(0, 100, "onboard", wrong="2, but 3 was expected"),
        answered(2, 100, "onboard", unverified="too large"),
    ]
    run = Run("arm-busy", 4, "cloud", Outcome({"robot": 3}, tasks), {})
    where = "arm-busy, seed 4, policy cloud, task"
    assert faults([run]) == {
        "lost": [f"{where} 1: lost"],
        "failed": [],
        "wrong": [f"{where} 0: wrong: 2, but 3 was expected"],
        "unverified": [f"{where} 2: unverified: too large"],
    }


@pytest.mark.parametrize("lost", [None, 2])
def test_a_lost_answer_is_named_and_gives_exit_code_1(
    lost: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Table, tasks and picture are written all the same."""
    pytest.importorskip("pupil_apriltags", reason="needs the extra 'apriltags'")

    def play(one: Planned, _kind: object) -> Run:
        one.out.mkdir(parents=True)
        (one.out / "summary.json").write_text(json.dumps({"started_at": "2026-11-25T10:00:00+00:00"}))
        return made(one.policy, lost=lost if one.policy == "cloud" else None)

    monkeypatch.setattr(applications, "play", play)
    flags = ["apriltags", "--scenarios", "calm", "--tasks", "4", "--out", str(tmp_path)]
    assert applications.main(flags) == (0 if lost is None else 1)
    out, error = capsys.readouterr()
    assert ("apriltags-calm, seed 1, policy cloud, task 2: lost\n" in error) == (lost is not None)
    text = (tmp_path / "apriltags.md").read_text()
    assert f"Of 16 answers: {0 if lost is None else 1} lost, 0 failed, 0 wrong, 0 unverified." in text
    assert "Measured on 25 November 2026 at commit " in text
    said = f"-m benchmarks.applications apriltags --tasks 4 --scenarios calm --out {tmp_path}"
    assert f"Seed 1, 4 tasks in each run: `python {said}`." in text
    assert text in out
    assert len((tmp_path / "apriltags-tasks.csv").read_text().splitlines()) == 5
    picture = (tmp_path / "apriltags.svg").read_bytes()
    assert b"points-cloud" in picture
    assert len(picture) < 60_000


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["apriltag"], "unknown application 'apriltag'; did you mean 'apriltags'?"),
        (["--scenarios", "calm,storm"], "--scenarios: 'storm' is not one of calm, outage, bandwidth, busy"),
        (["--seeds", "0"], "--seeds: 0 is below 1, the minimum"),
    ],
)
def test_a_wrong_value_is_one_line(flags: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It gives exit code 2."""
    assert applications.main(flags) == 2
    assert capsys.readouterr().err == f"python -m benchmarks.applications: {said}\n"
