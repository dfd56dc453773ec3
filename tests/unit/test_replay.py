"""`loadgen replay` against the table, the twelve rows of docs/evaluation.md, and traces that know less."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.table import table_two as evaluate
from offboard.loadgen.table.replay import ReplayConfig, replay, run_replay
from offboard.loadgen.table.rows import read
from offboard.loadgen.table.table_two import TableConfig
from offboard.robot_client import policies
from offboard.robot_client.policies import Decision, Forecast, Outlook
from offboard.robot_client.records.trace import Record, Trace
from offboard.robot_client.sites.runner import Execution
from tests.unit.test_evaluate import THOUSAND, TWELVE, csv_of

Replayed = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def replayed(capsys: pytest.CaptureFixture[str]) -> Replayed:
    """Runs the command; the lines of its first table."""

    def run(path: Path, **settings: Any) -> list[dict[str, Any]]:
        assert run_replay(path, ReplayConfig(format="json", **settings)) == 0
        lines: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["tables"][0]["scores"]
        return lines

    return run


def dataset(folder: Path, text: str) -> Path:
    path = folder / "d.csv"
    path.write_text(text)
    return path


def trace_of(folder: Path, *records: tuple[str, str, dict[str, float], float]) -> Path:
    """A trace of (policy, chosen site, seconds by site, waited_s)."""
    path = folder / "trace.jsonl"
    written = Trace(path)
    for i, (policy, site, seconds, waited_s) in enumerate(records):
        executions = tuple(Execution(name, s) for name, s in seconds.items())
        decision = Decision(site, "", policy, both=len(seconds) > 1)
        sites = {name: Outlook() for name in seconds}
        written.write(Record(i, f"t-{i}", "plan", 1.0 + i % 3, sites, decision, executions, site, waited_s))
    written.close()
    return path


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_paper_policy_equals_the_table(tmp_path: Path, replayed: Replayed, feedback: str) -> None:
    """The robot's own code on replaying runners decides as line N of the table, in both feedback modes."""
    path = dataset(tmp_path, csv_of(THOUSAND))
    (paper, *_) = replayed(path, policies=("paper",), window=30, feedback=feedback)
    (table,) = evaluate.tables(path, read(path), TableConfig(windows=("30",), feedback=feedback))
    line = table.lines[0]
    for name in ("scored", "accuracy_percent", "cloud_percent", "time_over_oracle", "regret_s"):
        assert paper[name] == getattr(line, name), name


def test_twelve_rows_by_hand(tmp_path: Path, replayed: Replayed) -> None:
    """The times of docs/evaluation.md: 45 s by the rule, 51 onboard, 35 in the cloud, 33 for the oracle."""
    lines = replayed(dataset(tmp_path, TWELVE), window=3, policies=("paper", "onboard", "cloud"))
    assert [(line["policy"], line["scored"]) for line in lines] == [
        *(("paper", 9), ("onboard", 9), ("cloud", 9), ("oracle", 9))
    ]
    assert [line["mean_s"] * 9 for line in lines] == pytest.approx([45, 51, 35, 33])
    # Of the nine times 3 7 4 3 6 7 3 6 6 the ninth is the P95 and the P99.
    assert (lines[0]["p95_s"], lines[0]["p99_s"]) == (7, 7)
    assert lines[0]["regret_mean_s"] == pytest.approx(12 / 9)
    assert [line["cloud_percent"] for line in lines[1:3]] == [0, 100]


def test_a_task_on_both_sites_takes_as_long_as_the_first_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy that runs everything twice gets the faster site's answer, and its double work is seen."""

    class Twice:
        def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002 - whatever it is
            return Decision("onboard", "", "twice", both=True)

    monkeypatch.setattr(policies, "make", lambda _name, _seed: Twice())
    rows = read(dataset(tmp_path, TWELVE))
    played = replay(rows, "twice", predictor="least-squares", window=3, feedback="chosen")
    assert played.both.all()
    assert played.to_cloud.tolist() == (rows.cloud_s < rows.onboard_s)[3:].tolist()


def test_only_chosen_sides_leave_the_rest_open(tmp_path: Path, replayed: Replayed) -> None:
    """A live trace says what was waited and where tasks went; nothing of other policies or the oracle."""
    times = [0.1, 0.2, 0.3, 0.4]
    path = trace_of(
        tmp_path,
        *(
            ("paper", site, {site: s}, s + 0.01)
            for site, s in zip(["onboard", "cloud"] * 2, times, strict=True)
        ),
    )
    recorded, *others = replayed(path)
    assert recorded["policy"] == "as recorded"
    assert (recorded["scored"], recorded["cloud_percent"]) == (4, 50)
    assert recorded["mean_s"] == pytest.approx(0.26)
    assert recorded["p95_s"] == pytest.approx(0.41)
    undefined = ("time_over_oracle", "regret_s", "accuracy_percent")
    assert all(recorded[name] is None for name in undefined)
    for line in others:
        assert line["note"] == "cannot be told: no tasks ran on both sites, the warm-up takes 50"
        assert line["mean_s"] is None


def test_measured_and_pinned_tasks_are_not_the_policys(tmp_path: Path, replayed: Replayed) -> None:
    """What ran on both sites, and what the caller placed, is not in the line of the recorded run."""
    both = {"onboard": 0.2, "cloud": 0.1}
    path = trace_of(
        tmp_path,
        *[("pinned", "onboard", both, 0.2)] * 5,
        ("pinned", "cloud", {"cloud": 0.5}, 0.5),
        ("paper", "cloud", {"cloud": 0.1}, 0.1),
    )
    recorded, paper, *_ = replayed(path, window=3)
    assert (recorded["scored"], recorded["mean_s"]) == (1, 0.1)
    assert (paper["scored"], paper["mean_s"]) == (2, 0.1)


def test_kinds_are_not_mixed(tmp_path: Path, replayed: Replayed) -> None:
    """A live trace of two kinds asks which; tasks of the other are not counted."""
    path = trace_of(tmp_path, *[("paper", "cloud", {"cloud": 0.1}, 0.1)] * 2)
    text = path.read_text()
    path.write_text(text + text.replace('"kind":"plan"', '"kind":"look"'))
    with pytest.raises(
        DataError, match=r"several kinds: plan \(line 1\), look \(line 3\); choose one with --kind"
    ):
        replayed(path)
    assert replayed(path, kind="look")[0]["scored"] == 2


def test_intervals_hold_the_estimate(tmp_path: Path, replayed: Replayed) -> None:
    """With --bootstrap each policy has three lines: the figure lies between its two ends."""
    path = dataset(tmp_path, csv_of(THOUSAND[:300]))
    lines = replayed(path, policies=("paper",), bootstrap=True)
    found, low, high = lines[:3]
    assert [line["bound"] for line in lines[:3]] == ["", "2.5 %", "97.5 %"]
    for name in ("mean_s", "p95_s", "time_over_oracle", "accuracy_percent"):
        assert low[name] < found[name] < high[name]


@pytest.mark.parametrize("format", ["md", "csv", "latex"])
def test_every_format_names_policy_and_feedback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], format: str
) -> None:
    """A table without figures is printed too; its lines say why."""
    run_replay(dataset(tmp_path, TWELVE), ReplayConfig(format=format, feedback="both"))
    out = capsys.readouterr().out
    assert out.count("12 tasks ran on both sites, the warm-up takes 50") == 2 * (len(policies.names()) + 2)
    assert "chosen" in out
    assert "full" in out


def test_mistakes_are_named(tmp_path: Path) -> None:
    """An unknown policy or predictor, and a file that is not there."""
    with pytest.raises(ConfigError, match="--policies: 'papr' is not one of paper, onboard, cloud"):
        ReplayConfig(policies=("papr",))
    with pytest.raises(ConfigError, match="--predictor: 'x' is not one of least-squares"):
        ReplayConfig(predictor="x")
    with pytest.raises(DataError, match="No such file"):
        run_replay(tmp_path / "none.jsonl", ReplayConfig())
