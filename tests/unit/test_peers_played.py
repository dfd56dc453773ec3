"""The rules of peers as they are played: tasks that cost what was measured, a busy server, and an oracle."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.application_costs import COLUMNS, FOLDER, NAMES, mean_cpu_s, tasks_of
from benchmarks.claims_of_others import families_table, links_table, servers_table
from benchmarks.peers_played import (
    FROM_TASK,
    LOAD,
    LOADED_S,
    OFFBOARD,
    ONE,
    ORACLE,
    OTHER,
    REPLICATE,
    ROBOT_ALONE,
    STRATEGIES,
    TURNS,
    TWO,
    Taken,
    contended,
    played,
    slow_in_turn,
)
from offboard.robot_client.sites.runner import CLOUD, ONBOARD


@pytest.mark.parametrize("name", NAMES)
def test_tasks_cost_what_was_measured(name: str) -> None:
    """Every row is one task, on both sites; another seed gives another order."""
    rows = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)
    first, second = tasks_of(name, 1), tasks_of(name, 2)
    assert first == tasks_of(name, 1)
    assert first.tasks != second.tasks
    for tasks in (first, second):
        for site in (ONBOARD, CLOUD):
            seconds = sorted(tasks.cost.cpu_s(one.work[site]) for one in tasks.tasks)
            assert seconds == pytest.approx(sorted(rows[:, COLUMNS.index("cpu_s")]))
        assert sorted(one.bytes_out for one in tasks.tasks) == sorted(rows[:, COLUMNS.index("bytes_out")])
    assert first.reports_work == (name != "apriltags"), "its answers do not say how much work it was"
    assert mean_cpu_s(name) == pytest.approx(rows[:, COLUMNS.index("cpu_s")].mean())


@pytest.mark.parametrize("name", NAMES)
def test_other_robots_keep_a_contended_server_busy_for_the_stated_share(name: str) -> None:
    """The share of time in which a request of theirs is there is the load, in each minute of a run."""
    case = contended(name, 2)
    assert case.scenarios[0].events != case.scenarios[1].events
    for scenario in case.scenarios:
        at = np.array([event.at_s for event in scenario.events])
        there = np.array([event.value[CLOUD] for event in scenario.events])
        assert (np.diff(at) >= 0).all()
        assert there.min() == there[-1] == 0
        assert set(np.abs(np.diff(there))) == {1}
        for minute in range(TURNS):
            edges = np.clip([*at, TURNS * LOADED_S], minute * LOADED_S, (minute + 1) * LOADED_S)
            busy_s = np.diff(edges)[there > 0].sum()
            assert busy_s / LOADED_S == pytest.approx(LOAD, abs=0.03)


def test_no_rule_is_faster_than_the_oracle_and_each_runs_as_often_as_it_says() -> None:
    """On a short run of the real simulation; replication to all runs three times, one server once."""
    case = slow_in_turn("registration", 1)
    short = replace(case, scenarios=[one.changed(tasks=120) for one in case.scenarios])
    found = played(short)
    assert list(found) == [*STRATEGIES, ORACLE]
    assert all(found[ORACLE].mean_s <= one.mean_s for one in found.values())
    runs = {name: one.runs for name, one in found.items()}
    assert (runs[ONE], runs[ROBOT_ALONE], runs[TWO], runs[REPLICATE], runs[ORACLE]) == (1, 1, 2, 3, None)
    assert (found[ONE].both_percent, found[REPLICATE].both_percent) == (0.0, 100.0)
    assert all(len(one.seconds) == 120 - FROM_TASK for one in found.values())
    assert found[ROBOT_ALONE].megabytes == 0.0


def taken(scale: float, runs: float = 1.0, both_percent: float = 0.0) -> Taken:
    """A hundred tasks of scale x 1 to 100 ms."""
    return Taken([scale * n / 1e3 for n in range(1, 101)], runs, 0.5, both_percent)


def test_the_tables_divide_what_they_say() -> None:
    """P99 over that of one server, of the better single link, and of the better constant of a recording."""
    of = {ONE: taken(10), REPLICATE: taken(1, 3.0), OFFBOARD: taken(2)}
    table = servers_table("here", {"arm": of})
    assert table.rows[-1] == ["arm", OFFBOARD, "101", "190", "198", "1.00", "0.500", "5.00"]
    assert [one.value for one in table.requirements] == pytest.approx([5.0, 2.0, 1.0])


def test_the_table_of_two_links_has_geometric_means_over_pairs() -> None:
    """The better single link is that of the pair; 2 / 4 and 8 / 4 cancel, 2 / 1 and 8 / 1 give 4."""
    pairs = [
        {ONE: taken(10), REPLICATE: taken(1), OFFBOARD: taken(2, both_percent=10.0), OTHER: taken(4)},
        {ONE: taken(4), REPLICATE: taken(1), OFFBOARD: taken(8, both_percent=30.0), OTHER: taken(9)},
    ]
    table = links_table("there", {"arm": pairs})
    (ours,) = [row for row in table.rows if row[1] == OFFBOARD]
    assert ours[-3:] == ["1.00 [0.50, 2.00]", "4.00 [2.00, 8.00]", "20.0"]
    assert [one.value for one in table.requirements] == pytest.approx([1.0, 4.0, 20.0])


def test_the_table_of_families_divides_by_the_better_constant_of_each_recording() -> None:
    """Whichever it is; the interval is that over recordings."""
    pairs = [
        {ONE: taken(1), ROBOT_ALONE: taken(4), OFFBOARD: taken(2)},
        {ONE: taken(4), ROBOT_ALONE: taken(1), OFFBOARD: taken(8)},
    ]
    table = families_table({("arm", "car"): pairs})
    assert [row[2] for row in table.rows] == ["always cloud", ROBOT_ALONE, OFFBOARD]
    assert table.rows[-1][-2:] == ["4.00 [2.00, 8.00]", "4.00 [2.00, 8.00]"]
    assert table.title == "One server behind recorded links: 2 of car"
