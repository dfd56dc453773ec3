"""Plays the rules of peers in simulation, with tasks that cost what those of an application took.

`claims_of_others` makes tables of what they took.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.application_costs import mean_cpu_s, tasks_of
from benchmarks.arrivals import arrivals
from offboard.loadgen.compare.recordings import RecordedLink, at_rate, over
from offboard.loadgen.compare.runs import read_scenarios
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.scenario import CloudPart, Scenario
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.table.table_two_figures import quantile
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

HERE = Path(__file__).parent
PEERS = "offboard.loadgen.rivals.peer_policies"
ONE, OTHER, TWO, REPLICATE = "one server", "the other link", "two servers at once", "all servers at once"
ROBOT_ALONE, PUBLISHED, OFFBOARD, ORACLE = "always onboard", "the published rule", "Offboard", "oracle"
STRATEGIES: Mapping[str, str] = {
    ONE: CLOUD,
    ROBOT_ALONE: ONBOARD,
    PUBLISHED: "paper",
    "hedge at P90 (as hedge-python)": f"{PEERS}.HedgeAtP90",
    TWO: f"{PEERS}.TwoServers",
    REPLICATE: f"{PEERS}.Replicate",
    OFFBOARD: "default",
}
ALONE = (ONE, ROBOT_ALONE, PUBLISHED, OFFBOARD)  # those that differ from each other with one server
FROM_TASK = 60  # the window of the published rule is full after 50 tasks
LINK_TASKS = 300  # at RATE, they last longer than most recordings
RATE = 2.0  # tasks a second on two links
LOAD, ASKED = 0.9, "azure-conv"  # of a contended server by other robots, and when they ask
LOADED_S, TURNS = 60.0, 10  # they ask like this for so long, again and again


@dataclass(frozen=True, slots=True)
class Taken:
    """What the counted tasks of one strategy took. `both_percent`: those that two or more servers ran.

    The oracle has no runs and no bytes.
    """

    seconds: Sequence[float]
    runs: float | None = None
    megabytes: float | None = None
    both_percent: float = 0.0

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> "Taken":
        tasks = list(_counted(outcomes))
        servers = [sum(site != ONBOARD for site in one.sites) for one in tasks]
        return cls(
            seconds=[one.response_s for one in tasks],
            runs=float(np.mean([len(one.sites) for one in tasks])),
            megabytes=float(np.mean([one.spent.bytes for one in tasks])) / 1e6,
            both_percent=100 * float(np.mean([count > 1 for count in servers])),
        )

    @classmethod
    def of_oracle(cls, outcomes: Sequence[Outcome]) -> "Taken":
        """The site that would really have been fastest for each task of these runs."""
        return cls([one.oracle_s for run in outcomes for one in run.references if one.i >= FROM_TASK])

    @property
    def mean_s(self) -> float:
        return float(np.mean(self.seconds))

    def percentile_s(self, percent: int) -> float:
        return float(quantile(np.array(self.seconds), percent))


@dataclass(frozen=True)
class Case:
    """An application on one testbed, with each seed and strategy."""

    task: str
    scenarios: Sequence[Scenario]
    strategies: Sequence[str] = tuple(STRATEGIES)
    group: str = ""


def played(case: Case) -> dict[str, Taken]:
    """What each strategy took in all runs of a case, and what the oracle would have taken.

    There is no oracle where tasks come at a rate, because several of them run at once.
    """
    found = {}
    for name in case.strategies:
        outcomes = [
            simulate(one.changed(policy=STRATEGIES[name]), {ROBOT: tasks_of(case.task, one.seed)}, noise=0.0)
            for one in case.scenarios
        ]
        found[name] = Taken.of(outcomes)
        if name == OFFBOARD and any(run.references for run in outcomes):
            found[ORACLE] = Taken.of_oracle(outcomes)
    return found


def slow_in_turn(task: str, seeds: int) -> Case:
    """Three equal servers, each of them slow or without a link for a while."""
    return Case(task, _seeded(_replicas(), seeds))


def contended(task: str, seeds: int) -> Case:
    """Three equal servers; other robots, whose requests come as recorded, share the core of the first one."""
    quiet = replace(_replicas(), events=())
    run_s = mean_cpu_s(task)
    return Case(task, [replace(one, events=_others(run_s, one.seed)) for one in _seeded(quiet, seeds)])


def on_two_links(task: str, pair: tuple[RecordedLink, RecordedLink], seeds: int) -> tuple[Case, Case]:
    """One robot with two links, each to an equal server, as FogROS2-PLR has two 5G providers.

    Tasks come at a rate, so that those that are due while a link is silent count too. The second case has the
    other link alone.
    """
    scenario = at_rate(replace(_replicas(), events=()).changed(tasks=LINK_TASKS), RATE)

    def over_both(first: RecordedLink, second: RecordedLink) -> list[Scenario]:
        return [
            replace(
                one,
                servers=tuple(
                    CloudPart(name, link=_from_a_start(link, one.seed))
                    for name, link in ((CLOUD, first), ("second", second))
                ),
            )
            for one in _seeded(scenario, seeds)
        ]

    strategies = [name for name in STRATEGIES if name != TWO]
    return Case(task, over_both(*pair), strategies), Case(task, over_both(pair[1], pair[0]), [ONE])


def on_one_link(task: str, link: RecordedLink, seeds: int) -> Case:
    """One server behind a recorded link."""
    scenario = replace(_replicas(), events=(), servers=(CloudPart(),)).changed(tasks=LINK_TASKS)
    scenarios = [over(scenario, link, one.seed) for one in _seeded(scenario, seeds)]
    return Case(task, scenarios, ALONE, group=link.family)


def _replicas() -> Scenario:
    (scenario,) = read_scenarios([str(HERE / "replicas.toml")])
    return scenario


def _seeded(scenario: Scenario, seeds: int) -> list[Scenario]:
    return [scenario.changed(seed=scenario.seed + n) for n in range(seeds)]


def _others(run_s: float, seed: int) -> tuple[Event, ...]:
    """How many requests of other robots the first server has, as a queue with one worker has them.

    The simulated server shares its core among them and the task of our robot, as processes do.
    """
    come = np.array(arrivals(ASKED, LOAD / run_s, LOADED_S, seed))
    come = np.concatenate([come + turn * LOADED_S for turn in range(TURNS)])
    leave = np.empty_like(come)
    free_s = 0.0
    for n, at_s in enumerate(come):
        free_s = leave[n] = max(at_s, free_s) + run_s
    at = np.concatenate([come, leave])
    changes = np.concatenate([np.ones(len(come), int), -np.ones(len(leave), int)])
    order = np.argsort(at, kind="stable")
    there = np.cumsum(changes[order])
    return tuple(
        Event("hogs", {CLOUD: int(count)}, at_s=float(at_s))
        for at_s, count in zip(at[order], there, strict=True)
    )


def _from_a_start(link: RecordedLink, seed: int) -> dict[str, Any]:
    """The flags of a link that plays this recording from a start that the seed draws."""
    flags: dict[str, Any] = dict(link.files)
    recorded = LinkFlags(**flags).link.up.recording
    assert recorded is not None, "the link has a recording"
    place = Random(f"{seed}/{link.name}").random()
    return {**link.files, "recording_from_s": place * recorded.recording.length_s}


def _counted(outcomes: Sequence[Outcome]) -> Iterator[Answered]:
    return (one for run in outcomes for one in run.answered if one.i >= FROM_TASK)
