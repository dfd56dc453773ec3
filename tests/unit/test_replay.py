"""`loadgen replay`, compared with `loadgen table`, the twelve rows of docs/evaluation.md, and live traces."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.common.tasks import task
from offboard.loadgen.replay.replay import replay_policy, run_replay
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.table import table_two
from offboard.loadgen.table.measured_rows import Rows, read
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two import predict
from offboard.robot_client import policies
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH, Decision, Forecast, Outlook, Policy
from offboard.robot_client.policies.baselines import Paper
from offboard.robot_client.records.record import Record
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner
from tests.recorded_rows import of_rows
from tests.table_loops import THOUSAND, TWELVE, csv_of

DATASETS = Path(__file__).parents[2] / "loadgen" / "datasets"

Replayed = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def replayed(capsys: pytest.CaptureFixture[str]) -> Replayed:
    """Runs the command and returns the lines of its first table."""

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
    """A trace with one record for each (policy, chosen site, seconds by site, waited_s)."""
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
    """The robot's own code gives the same figures as line N of the table, in both feedback modes."""
    path = dataset(tmp_path, csv_of(THOUSAND))
    (paper, *_) = replayed(path, policies=("paper",), window=30, feedback=feedback)
    (table,) = table_two.tables(path, read(path), TableConfig(windows=("30",), feedback=feedback))
    line = table.lines[0]
    for name in ("scored", "accuracy_percent", "cloud_percent", "time_over_oracle", "regret_s"):
        assert paper[name] == getattr(line, name), name


@pytest.mark.parametrize("predictor", ["least-squares", "parts"])
@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_table_replay_and_robot_predict_the_same(predictor: str, feedback: str) -> None:
    """For the same sizes and seconds, table, replay and the offloader of a robot predict the same.

    Robot and replay also ask during the warm-up, and a window may then round its sums anew.
    """
    rows, window = read(DATASETS / "paper.csv"), 30
    table = predict(rows, window, predictor=predictor, feedback=feedback, seed=1)
    settings = Settings(predictor=predictor, window=window)
    played = Foretold(every=feedback == "full")
    memories = settings.make_memories("paper")
    replay_policy(of_rows(rows), played, memories=memories, window=window, feedback=feedback)
    robot = Foretold(every=feedback == "full")
    live(rows, robot, settings.make_memories("paper"), window)
    for one in (played, robot):
        assert [found[ONBOARD] for found in one.predicted_s] == pytest.approx(table[0].tolist(), rel=1e-9)
        assert [found[CLOUD] for found in one.predicted_s] == pytest.approx(table[1].tolist(), rel=1e-9)


class Foretold(Paper):
    """The rule of the paper, which keeps the predictions it decides from; with `every`, both sites run."""

    def __init__(self, *, every: bool) -> None:
        self.predicted_s: list[dict[str, float | None]] = []
        self._every = every

    def decide(self, forecast: Forecast) -> Decision:
        self.predicted_s.append({site: one.predicted_s for site, one in forecast.sites.items()})
        return super().decide(forecast)._replace(both=self._every)


def live(rows: Rows, policy: Policy, memories: Memories, warm_up: int) -> None:
    """The offloader of a robot runs all rows, the first ones on both sites."""
    taken_s = {ONBOARD: rows.onboard_s.tolist(), CLOUD: rows.cloud_s.tolist()}

    def runner(site: str) -> ScriptedRunner:
        return ScriptedRunner(site, lambda task: Execution(site, taken_s[site][task.args[1]]))

    with Offloader([runner(ONBOARD), runner(CLOUD)], policy=policy, memories=memories) as offload:
        for number, size in enumerate(rows.size.tolist()):
            offload(measured, size, number, where=BOTH if number < warm_up else None)


@task("measured", size=lambda size, number: size)  # noqa: ARG005
def measured(size: float, number: int) -> None:
    """A task whose times are known."""


def test_the_twelve_rows_equal_those_by_hand(tmp_path: Path, replayed: Replayed) -> None:
    """As in docs/evaluation.md: 45 s by the published rule, 51 s onboard, 35 s in the cloud, 33 s at best."""
    lines = replayed(dataset(tmp_path, TWELVE), window=3, policies=("paper", "onboard", "cloud"))
    assert [(line["policy"], line["scored"]) for line in lines] == [
        *(("paper", 9), ("onboard", 9), ("cloud", 9), ("oracle", 9))
    ]
    assert [line["mean_s"] * 9 for line in lines] == pytest.approx([45, 51, 35, 33])
    # Of the nine times 3 7 4 3 6 7 3 6 6 the ninth is the P95 and the P99.
    assert (lines[0]["p95_s"], lines[0]["p99_s"]) == (7, 7)
    assert lines[0]["regret_mean_s"] == pytest.approx(12 / 9)
    assert [line["cloud_percent"] for line in lines[1:3]] == [0, 100]


def test_a_task_on_both_sites_takes_as_long_as_the_first_answer(tmp_path: Path) -> None:
    """A policy that runs every task on both sites gets the faster site's time, and the table shows it."""

    class Twice:
        def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
            return Decision("onboard", "", "twice", both=True)

    rows = read(dataset(tmp_path, TWELVE))
    memories = Settings(window=3).make_memories("paper")
    played = replay_policy(of_rows(rows), Twice(), memories=memories, window=3, feedback="chosen")
    assert played.both.all()


def test_a_live_trace_gives_only_the_line_of_the_recorded_run(tmp_path: Path, replayed: Replayed) -> None:
    """A live trace has no times for other policies and the oracle, and their lines say so."""
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
        assert line["note"] == "cannot be replayed: no tasks ran on both sites, but the warm-up needs 50"
        assert line["mean_s"] is None


def test_the_recorded_line_leaves_out_measured_and_pinned_tasks(tmp_path: Path, replayed: Replayed) -> None:
    """Tasks that ran on both sites, or that the caller placed, are not in the line of the recorded run."""
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


def test_kinds_of_tasks_are_not_mixed(tmp_path: Path, replayed: Replayed) -> None:
    """A trace with two kinds needs --kind, and tasks of the other kind are left out."""
    path = trace_of(tmp_path, *[("paper", "cloud", {"cloud": 0.1}, 0.1)] * 2)
    text = path.read_text()
    path.write_text(text + text.replace('"kind":"plan"', '"kind":"look"'))
    with pytest.raises(
        DataError, match=r"several kinds: plan \(line 1\), look \(line 3\); choose one with --kind"
    ):
        replayed(path)
    assert replayed(path, kind="look")[0]["scored"] == 2


def test_each_interval_contains_its_figure(tmp_path: Path, replayed: Replayed) -> None:
    """With --bootstrap each policy has three lines, and the figure lies between its two bounds."""
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
    """A table without figures is printed too, and its lines say why there are none."""
    run_replay(dataset(tmp_path, TWELVE), ReplayConfig(format=format, feedback="both"))
    out = capsys.readouterr().out
    said = "12 tasks ran on both sites, but the warm-up needs 50"
    assert out.count(said) == 2 * (len(policies.names()) + 2)
    assert "chosen" in out
    assert "full" in out


def test_an_unknown_name_or_file_is_refused(tmp_path: Path) -> None:
    """An unknown policy or predictor, and a missing file, are errors that name it."""
    with pytest.raises(ConfigError, match=r"--policies: 'papr' is not one of paper, .* greedy"):
        ReplayConfig(policies=("papr",))
    with pytest.raises(ConfigError, match=r"--predictor: 'x' is not one of least-squares, .* k-means"):
        ReplayConfig(predictor="x")
    with pytest.raises(DataError, match="No such file"):
        run_replay(tmp_path / "none.jsonl", ReplayConfig())


def test_window_and_predictor_are_those_of_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The summary next to a trace gives what the user did not, and the caption says so."""
    times = {"onboard": 0.1, "cloud": 0.2}
    path = trace_of(tmp_path, *(("paper", "onboard", times, 0.1) for _ in range(40)))
    summary = path.with_name("summary.json")

    def caption(**settings: Any) -> str:
        assert run_replay(path, ReplayConfig(policies=("paper",), **settings)) == 0
        return " ".join(capsys.readouterr().out.partition("\n\n")[0].split())

    own = "predictor each policy's own"
    assert f"{own}, window 50, feedback" in caption()
    summary.write_text(json.dumps({"window": 20, "predictor": None}))
    assert f"{own}, window 20 of the run, feedback" in caption()
    summary.write_text(json.dumps({"window": 20, "predictor": "parts"}))
    assert "predictor parts of the run, window 20 of the run, feedback" in caption()
    assert "predictor least-squares, window 10, feedback" in caption(window=10, predictor="least-squares")
    summary.write_text(json.dumps({"name": "calm"}))  # of an earlier version
    assert f"{own}, window 50, feedback" in caption()


def test_an_objective_that_the_run_cannot_weigh_is_an_error(tmp_path: Path) -> None:
    """A deadline is known only if the run had one, and a rule without costs has no objective."""
    path = trace_of(tmp_path, *(("paper", "onboard", {"onboard": 0.1, "cloud": 0.2}, 0.1) for _ in range(40)))
    with pytest.raises(ConfigError, match=r"--policies: 'default\+deadline': .* in the summary of the run"):
        run_replay(path, ReplayConfig(policies=("default+deadline",)))
    with pytest.raises(ConfigError, match="an objective changes nothing with paper"):
        ReplayConfig(policies=("paper+p95",))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", r"summary\.json: no summary of a run: Expecting property name"),
        ("[]", r"summary\.json: no summary of a run: 'list'"),
        ('{"window": 1}', r"summary\.json: window: 1 is not a whole number from 2 to"),
        ('{"window": "many"}', r"summary\.json: window: 'many' is not a whole number"),
        ('{"predictor": "crystal"}', r"summary\.json: predictor: .*crystal"),
        ('{"decided_by": 3}', r"summary\.json: no summary of a run: 'int'"),
        (
            '{"decided_by": {"objective": "luck"}}',
            r"decided_by: objective: 'luck' is not one of",
        ),
        (
            '{"decided_by": {"objective": "deadline"}}',
            r"decided_by: objective 'deadline' needs",
        ),
        ('{"decided_by": {"luck": 1}}', r"summary\.json: decided_by: .*luck"),
        ('{"decided_by": {"idle_w": -1}}', r"summary\.json: decided_by: .*idle_w"),
    ],
)
def test_a_wrong_summary_is_an_error(tmp_path: Path, text: str, expected: str) -> None:
    """The error names the file and the field."""
    path = trace_of(tmp_path, ("paper", "onboard", {"onboard": 0.1, "cloud": 0.2}, 0.1))
    path.with_name("summary.json").write_text(text)
    with pytest.raises((DataError, ConfigError), match=expected):
        run_replay(path, ReplayConfig())
