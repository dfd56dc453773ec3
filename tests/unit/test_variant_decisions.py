"""What policies, races, batches, memory and trace make of variants. Time is virtual."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind, Task, kind_of
from offboard.robot_client import predictors
from offboard.robot_client.execution.choice import plan_of
from offboard.robot_client.execution.placement import Queue, next_start, takeover
from offboard.robot_client.execution.race import Plan, Race, answer_of
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.store import Store
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook, Probe, objectives
from offboard.robot_client.policies.forecast import WHOLE, Quality
from offboard.robot_client.policies.hedge import late_after_s
from offboard.robot_client.policies.objectives import Deadline, Expected, Mean, Tail, TimeAndSpending
from offboard.robot_client.policies.prediction_errors import PredictionErrors
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.outlooks import decide, known
from tests.variant_tasks import sort_in_the_cloud, sort_out
from tests.virtual import VirtualClock, VirtualRunner

HALF_S, WHOLE_S = 0.1, 0.4  # of the variants of `sort_out`: quality 0.5 onboard, and 1 in the cloud
WARM_UP = 6
TASKS = 60


class Robot:
    """A robot with the task `sort_out` on virtual sites; `records` holds each of its tasks."""

    def __init__(self, policy: str = "default", **settings: Any) -> None:
        self.clock = VirtualClock()
        self.onboard = VirtualRunner(ONBOARD, self.clock, HALF_S)
        self.cloud = VirtualRunner(CLOUD, self.clock, WHOLE_S)
        self.records: list[Record] = []
        made = Settings(predictor=predictors.LEAST_SQUARES, window=50, **settings)
        self.offload = Offloader(
            [self.onboard, self.cloud],
            policy=made.make_policy(policy),
            memories=made.make_memories(policy),
            allowance=made.allowance(),
            clock=self.clock,
            observers=[self.records.append],
        )

    def ask(self, tasks: int, **options: Any) -> list[str]:
        return [self.offload(sort_out, 7, **options) for _ in range(tasks)]

    def alone(self) -> list[Record]:
        """The tasks that were sent to one site."""
        return [one for one in self.records if not one.decision.both]


@pytest.mark.parametrize(
    ("s_per_quality", "site"), [(0.0, ONBOARD), (0.5, ONBOARD), (0.7, CLOUD), (None, CLOUD), (10.0, CLOUD)]
)
def test_the_better_variant_is_worth_a_longer_time(s_per_quality: float | None, site: str) -> None:
    """The cloud takes 0.3 s longer and has half a quality more, so it is used above 0.6 s per quality."""
    robot = Robot(**({} if s_per_quality is None else {"s_per_quality": s_per_quality}))
    answers = robot.ask(TASKS)
    assert {one.decision.site for one in robot.alone()} == {site}
    assert {one.used for one in robot.alone()} == {site}
    assert answers[-1] == f"{site} 7"


def test_the_better_answer_of_a_warm_up_counts() -> None:
    """All sites run these tasks and are waited for; the faster answer would be the worse one."""
    robot = Robot()
    assert robot.ask(WARM_UP) == ["cloud 7"] * WARM_UP
    assert all(one.decision.both and len(one.executions) == 2 for one in robot.records)


def test_a_caller_may_pin_a_variant() -> None:
    """`where` names the site, and so its variant; on both, the better answer counts."""
    robot = Robot()
    assert robot.ask(1, where=ONBOARD) == ["onboard 7"]
    assert robot.ask(1, where=CLOUD) == ["cloud 7"]
    assert robot.ask(1, where="both") == ["cloud 7"]


def test_a_probe_of_the_worse_variant_does_not_replace_the_better_answer() -> None:
    """Onboard is probed and answers first; the caller still gets the answer of the cloud."""
    robot = Robot()
    robot.ask(TASKS)
    probed = [one for one in robot.alone() if isinstance(one.decision.second, Probe)]
    assert probed
    for one in probed:
        assert (one.decision.second, one.used) == (Probe(ONBOARD), CLOUD)
        assert one.waited_s == pytest.approx(WHOLE_S)
        assert [run.ok for run in one.executions] == [True, True]


@pytest.mark.parametrize(
    ("cloud_s", "used", "waited_s"), [(0.4, CLOUD, 0.4), (0.05, CLOUD, 0.05), (1.5, ONBOARD, 0.6)]
)
def test_the_answer_of_a_probe_waits_as_long_as_it_is_worth(
    cloud_s: float, used: str, waited_s: float
) -> None:
    """Onboard answers after 0.1 s, and half a second more is worth its lost quality."""
    clock = VirtualClock()
    sites = {ONBOARD: VirtualRunner(ONBOARD, clock, HALF_S), CLOUD: VirtualRunner(CLOUD, clock, cloud_s)}
    race = Race(
        Task(kind_of(sort_out), (7,), 7.0),
        sites,
        clock,
        2.0,
        begun=lambda _: None,
        allowed=lambda _: True,
        late=lambda *_: None,
    )
    executions = race.run(Plan((CLOUD,), Probe(ONBOARD), lost_s={ONBOARD: 0.5, CLOUD: 0.0}))
    assert answer_of(executions, kind_of(sort_out)).site == used
    assert clock.now_s() == pytest.approx(waited_s)


def forecast(**lost_s: float) -> Forecast:
    return Forecast(
        size=1.0, sites={site: known(0.1, quality=Quality(0.5, lost)) for site, lost in lost_s.items()}
    )


@pytest.mark.parametrize(
    ("second", "both", "waits"),
    [
        (Probe(ONBOARD), False, True),
        (None, True, True),  # a warm-up
        (Hedge(ONBOARD, 0.1), False, False),
        (None, False, False),
    ],
)
def test_only_a_probe_and_a_warm_up_wait_for_the_better_answer(
    second: Probe | Hedge | None, both: bool, waits: bool
) -> None:
    """A hedge starts because the better answer is late by more than it is worth."""
    decision = Decision(CLOUD, "", "", second=second, both=both)
    plan = plan_of(decision, forecast(onboard=0.5, cloud=0.2), None)
    assert plan.lost_s == ({ONBOARD: 0.5, CLOUD: 0.2} if waits else {})


def late_errors() -> PredictionErrors:
    """The errors of a site that is sometimes very late."""
    found = Conformal()
    for n in range(100):
        found.learn(0.3, 0.3 + (0.01 * (n % 10) if n % 20 else 0.3 + 0.01 * n))
    return found.errors


def test_a_hedge_with_a_worse_variant_starts_later() -> None:
    """What the second site loses more counts as time that it needs."""
    due_s = []
    for lost_s in (0.1, 0.5):
        sites = {
            CLOUD: known(0.3, quality=Quality(1.0, 0.1), errors=late_errors()),
            ONBOARD: known(0.35, quality=Quality(0.5, lost_s)),
        }
        second = decide("hedge:cloud", sites, duplicates=5.0).second
        assert isinstance(second, Hedge)
        assert second.after_s == late_after_s(sites[CLOUD], 0.35 + lost_s - 0.1, lost_s - 0.1)
        due_s.append(second.after_s)
    assert due_s[0] < due_s[1]


@pytest.mark.parametrize("objective", [Mean(), Tail(), TimeAndSpending(0.0)])
def test_lost_quality_counts_as_seconds(objective: objectives.Objective) -> None:
    """With every objective whose cost is a time, it is added to the cost."""
    whole, errors = Expected(0.3, 0.0, 2.0), known(0.3).errors
    assert objective.cost(whole, errors) == pytest.approx(0.3)
    assert objective.cost(whole._replace(quality=Quality(0.8, 0.25)), errors) == pytest.approx(0.55)


def test_a_missed_deadline_loses_the_whole_quality() -> None:
    """The cost is the quality that is expected to be lost: certain answers of 0.8 cost 0.2."""
    sure, late = Expected(0.1, None, 0.0), Expected(0.9, None, 0.0)
    objective, errors = Deadline(0.5), known(0.1).errors
    assert objective.cost(sure._replace(quality=Quality(0.8)), errors) == pytest.approx(0.2, abs=1e-3)
    assert objective.cost(sure, errors) == pytest.approx(0.0, abs=1e-3)
    assert objective.cost(late._replace(quality=Quality(0.8)), errors) == pytest.approx(1.0, abs=1e-3)


def test_with_a_deadline_the_better_variant_is_used_while_it_is_in_time() -> None:
    """The worth in seconds plays no part: 0.4 s are in time for 0.5 s, and late for 0.3 s."""
    for deadline_s, site in ((0.5, CLOUD), (0.3, ONBOARD)):
        robot = Robot(objective=Deadline(deadline_s))
        robot.ask(20)
        assert robot.records[-1].decision.site == site
        assert robot.records[-1].sites[ONBOARD].quality == Quality(0.5, 0.0)


def test_the_published_rule_compares_times_only() -> None:
    """Algorithm 1 knows no quality."""
    robot = Robot("paper")
    robot.ask(TASKS)
    assert robot.records[-1].decision.site == ONBOARD


def test_the_reason_and_the_trace_say_the_quality() -> None:
    """The reason adds the worth of what is lost; the trace has the quality of each site."""
    robot = Robot()
    robot.ask(20)
    last = robot.records[-1]
    assert last.decision.reason.startswith("cloud: 400 ms")
    assert ", quality 1 against onboard 100 ms" in last.decision.reason
    assert " + 500 ms for quality 0.5; size 7" in last.decision.reason
    line = json.loads(json.dumps(as_dict(last)))
    assert {site: one["quality"] for site, one in line["sites"].items()} == {ONBOARD: 0.5, CLOUD: 1.0}


def test_a_task_without_variants_has_no_quality() -> None:
    """Neither its reason nor its trace mentions one, and its cost is its time."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2)}
    assert "quality" not in decide("greedy", sites).reason
    assert Outlook().quality is WHOLE
    assert Mean().cost(Expected(0.3, None, 1.0), known(0.3).errors) == 0.3


def queues(onboard_s: float) -> dict[str, Queue]:
    return {ONBOARD: Queue(ONBOARD, 1.0, lost_s=onboard_s), CLOUD: Queue(CLOUD, 1.0)}


def test_a_batch_uses_the_worse_variant_only_if_it_saves_more_than_it_loses() -> None:
    """The free onboard site would end the item 0.3 s earlier than the cloud, behind its other item."""
    for lost_s, site in ((0.0, ONBOARD), (0.2, ONBOARD), (0.4, CLOUD)):
        those = queues(lost_s)
        those[CLOUD].start(1, 0.2, 0.0)
        start = next_start([{ONBOARD: 0.1, CLOUD: 0.2}], those, 0.0)
        assert start is not None
        assert start.site == site


def test_a_take_over_counts_the_lost_quality() -> None:
    """Onboard would save 0.4 s of an item in the cloud; it takes the item only if it loses less."""
    for lost_s, taken in ((0.3, (1, ONBOARD)), (0.5, None)):
        those = queues(lost_s)
        those[CLOUD].start(1, 0.5, 0.0)
        assert takeover({1: {ONBOARD: 0.1, CLOUD: 0.5}}, those, 0.0) == taken


def remembered(path: Path, kind: Kind) -> tuple[KindMemory, Store]:
    memory = KindMemory(
        kind,
        lambda: predictors.make(predictors.LEAST_SQUARES, 50),
        shared_work=False,
        measured=False,
        s_per_quality=1.0,
    )
    store = Store(path)
    store.recall(memory, [ONBOARD, CLOUD])
    return memory, store


def learn(path: Path) -> None:
    """Write a memory file with observations of both sites of `sort_out`."""
    memory, store = remembered(path, kind_of(sort_out))
    for site in (ONBOARD, CLOUD):
        for _ in range(20):
            memory.site(site).learn(1.0, Execution(site, 0.2), None, silent=False, size=1.0)
    store.save_last(store.snapshot({"sort_out": memory}))


def counts(path: Path, kind: Kind) -> dict[str, int]:
    memory, _ = remembered(path, kind)
    return {site: memory.observations(site) for site in (ONBOARD, CLOUD)}


def test_a_site_starts_cold_if_the_source_of_its_variant_has_changed(tmp_path: Path) -> None:
    """The times of the other variants are still true."""
    path = tmp_path / "memory.json"
    learn(path)
    kind = kind_of(sort_out)
    assert counts(path, kind) == {ONBOARD: 20, CLOUD: 20}
    other = replace(kind.variants[CLOUD], source_hash="f" * 64)
    changed = replace(kind, variants={**kind.variants, CLOUD: other})
    assert counts(path, changed) == {ONBOARD: 20, CLOUD: 0}
    assert counts(path, replace(kind, source_hash="e" * 64)) == {ONBOARD: 0, CLOUD: 0}


def test_a_variant_that_is_not_here_starts_cold(tmp_path: Path) -> None:
    """Nobody can say whether the server still runs the same source."""
    path = tmp_path / "memory.json"
    learn(path)
    kind = kind_of(sort_out)
    lacks = {**kind.variants, CLOUD: replace(kind.variants[CLOUD], source_hash="")}
    assert counts(path, replace(kind, variants=lacks)) == {ONBOARD: 20, CLOUD: 0}


def test_a_memory_file_from_before_there_were_variants_is_read(tmp_path: Path) -> None:
    """Its sites have the source of their kind."""
    path, plain = tmp_path / "memory.json", Kind("sort_out", sort_in_the_cloud, float, source_hash="a" * 64)
    learn(path)
    whole = json.loads(path.read_text())
    for kind in whole["kinds"].values():
        kind["source"] = plain.source_hash
        for site in kind["sites"].values():
            del site["source"]
    path.write_text(json.dumps(whole))
    assert counts(path, plain) == {ONBOARD: 20, CLOUD: 20}


@pytest.mark.parametrize("worth_s", [-1.0, float("nan"), float("inf")])
def test_the_worth_of_quality_is_a_time(worth_s: float) -> None:
    """The error names the setting and its value."""
    with pytest.raises(ConfigError, match=r"^s_per_quality: (-1\.0|nan) is below 0|inf is above"):
        Settings(s_per_quality=worth_s)


def test_a_silent_cloud_is_left_for_the_variant_onboard() -> None:
    """It is expected to take the whole timeout, which is more than the lost quality is worth."""
    robot = Robot()
    robot.ask(20)
    sites = dict(robot.records[-1].sites)
    assert decide("greedy", sites).site == CLOUD
    silent = sites[CLOUD]._replace(condition=Condition(silent=True), predicted_s=2.0, cost=2.0)
    assert decide("greedy", sites | {CLOUD: silent}).site == ONBOARD
