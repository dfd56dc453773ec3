"""Recorded tasks in virtual time, with times that can be computed by hand."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import Overtaken
from offboard.loadgen.replay.dataset_file import write_dataset
from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.loadgen.replay.replay import replay, tables
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.replay.virtual_robot import Played, VirtualRobot
from offboard.loadgen.table.measured_rows import Rows
from offboard.robot_client.policies import Decision, Forecast, Hedge, Probe
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.recorded_rows import of_rows

Times = tuple[float, float]  # onboard, cloud


class Scripted:
    """Gives these decisions, one after the other."""

    def __init__(self, *decisions: Decision) -> None:
        self._decisions = list(decisions)

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self._decisions.pop(0)


def sent(site: str, second: Probe | Hedge | None = None, *, both: bool = False) -> Decision:
    return Decision(site, "", "scripted", both=both, second=second)


def tasks_of(times: Sequence[Times]) -> list[RecordedTask]:
    onboard_s, cloud_s = np.array(times).T
    return of_rows(Rows(np.ones(len(times)), onboard_s, cloud_s))


def played(times: Sequence[Times], *decisions: Decision, all_learn: bool = False) -> list[Played]:
    memories = Settings().make_memories("default")
    robot = VirtualRobot(Scripted(*decisions), memories, tells_work=False)
    return list(robot.play(tasks_of(times), warm_up=0, all_learn=all_learn))


@pytest.mark.parametrize("all_learn", [False, True])
def test_a_hedge_starts_when_it_is_due(all_learn: bool) -> None:
    """After 0.2 s the cloud starts too, and answers 0.05 s later; a task that ends earlier runs once."""
    hedge = sent(ONBOARD, Hedge(CLOUD, 0.2))
    late, early = played([(1.0, 0.05), (0.1, 0.05)], hedge, hedge, all_learn=all_learn)
    assert late == Played(to_cloud=True, twice=True, seconds=pytest.approx(0.25))
    assert early == Played(to_cloud=False, twice=False, seconds=pytest.approx(0.1))


@pytest.mark.parametrize("all_learn", [False, True])
def test_a_probe_answers_with_the_first(all_learn: bool) -> None:
    """Both sites start at once, and the task takes as long as the faster one."""
    probe = sent(CLOUD, Probe(ONBOARD))
    fast, slow = played([(0.1, 0.3), (1.0, 0.05)], probe, probe, all_learn=all_learn)
    assert fast == Played(to_cloud=False, twice=True, seconds=pytest.approx(0.1))
    assert slow == Played(to_cloud=True, twice=True, seconds=pytest.approx(0.05))


def test_the_next_task_onboard_waits_for_a_probe() -> None:
    """The probe goes on for 0.95 s after its task was answered; a task behind it takes that much longer."""
    _, behind = played([(1.0, 0.05), (0.1, 9.0)], sent(CLOUD, Probe(ONBOARD)), sent(ONBOARD))
    assert behind.seconds == pytest.approx(0.95 + 0.1)


def test_a_run_that_lost_to_a_hedge_is_stopped() -> None:
    """No task waits for a run whose answer is no longer wanted."""
    _, after = played([(1.0, 0.05), (0.1, 9.0)], sent(ONBOARD, Hedge(CLOUD, 0.2)), sent(ONBOARD))
    assert after.seconds == pytest.approx(0.1)


def test_a_run_that_was_stopped_in_the_run_is_stopped_when_the_task_is_answered() -> None:
    """Its seconds are those of the run, although the hedge had begun late there; then the site is free."""
    seen: list[Forecast] = []

    class Watching(Scripted):
        def decide(self, forecast: Forecast) -> Decision:
            seen.append(forecast)
            return super().decide(forecast)

    hedged = sent(CLOUD, Hedge(ONBOARD, 0.05))
    runs = {
        CLOUD: Execution(CLOUD, 0.06),
        ONBOARD: Execution(ONBOARD, 0.001, failure=Overtaken("stopped"), censored=True),
    }
    tasks = [
        RecordedTask(1.0, runs, decision=hedged, i=0, started_s=5.0, waited_s=0.06),
        RecordedTask(1.0, {CLOUD: runs[CLOUD]}, decision=sent(CLOUD), i=1, started_s=5.07, waited_s=0.06),
    ]
    memories = Settings().make_memories("default")
    robot = VirtualRobot(Watching(hedged, sent(CLOUD)), memories, tells_work=False)
    assert robot.follow(tasks) == [hedged, sent(CLOUD)]
    assert [forecast.sites[ONBOARD].in_flight for forecast in seen] == [0, 0]


def test_a_task_may_not_tell_its_work(caplog: pytest.LogCaptureFixture) -> None:
    """Among tasks that tell it, this is no error: nothing is logged, and every task is played."""
    tasks = [
        RecordedTask(1.0, {site: Execution(site, 0.1, work) for site in (ONBOARD, CLOUD)})
        for work in (5.0, None) * 10
    ]
    found = replay(tasks, "greedy", ReplayConfig(window=4), feedback="chosen")
    assert len(found.spent_s) == 16
    assert caplog.text == ""


def test_second_runs_end_with_the_allowance() -> None:
    """Of 100 hedges that are due, only as many start as the allowance permits."""
    found = played([(1.0, 0.05)] * 100, *[sent(ONBOARD, Hedge(CLOUD, 0.2))] * 100)
    assert 10 <= sum(one.twice for one in found) <= 16


def stalls() -> Rows:
    """Tasks that are faster in the cloud, with stalls there, until onboard becomes the faster site."""
    noise = 0.001 * (np.arange(200) * 7 % 11)
    onboard_s, cloud_s = 0.1 + noise, 0.05 + noise
    cloud_s[60:120:13] = 3.0
    onboard_s[130:] = 0.02 + noise[130:]
    return Rows(np.ones(200), onboard_s, cloud_s)


def test_probes_and_hedges_change_the_figures(tmp_path: Path) -> None:
    """Hedges shorten the stalls, and probes find the site that has become faster."""
    path = tmp_path / "stalls.csv"
    write_dataset(path, of_rows(stalls()))
    names = ("greedy", "probe:greedy", "hedge:greedy", "hedge:probe:greedy")
    (table,) = tables(path, ReplayConfig(policies=names, window=20))
    mean_s = {line.policy: line.mean_s for line in table.lines}
    assert len({mean_s[name] for name in names}) == len(names)
    assert mean_s["hedge:probe:greedy"] < mean_s["hedge:greedy"] < mean_s["greedy"]
    assert mean_s["hedge:probe:greedy"] < mean_s["probe:greedy"] < mean_s["greedy"]
    twice = {line.policy: line.both_percent for line in table.lines}
    assert twice["greedy"] == 0
    assert all(twice[name] > 0 for name in names[1:])


def test_a_second_run_never_answers_later_than_the_first() -> None:
    """With hedges, no task of this dataset takes longer than on the site that it was sent to."""
    rows = stalls()
    found = replay(of_rows(rows), "hedge:greedy", ReplayConfig(window=20), feedback="chosen").spent_s
    assert (found <= np.maximum(rows.onboard_s, rows.cloud_s)[20:] + 1e-9).all()
    assert found.max() < 1.0
