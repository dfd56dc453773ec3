"""How benchmarks measure and judge; `make bench` runs the benchmarks themselves."""

import subprocess
import sys
import time

import pytest

from benchmarks.measure import Bar, Table, each_of, interleaved


def test_every_case_runs_equally_often_in_changing_order() -> None:
    """Each case runs once before the first round and once in each; every other round runs backwards."""
    ran: list[str] = []
    seconds = interleaved({name: lambda name=name: ran.append(name) for name in "abc"}, rounds=3)
    assert "".join(ran) == "cbaabccbaabc"
    assert seconds.keys() == set("abc")


def test_the_time_of_many_calls_is_divided_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """A case makes the given number of calls, and its time is divided by that number."""
    now_s = 0.0

    def slow(count: int) -> None:
        nonlocal now_s
        now_s += count * 1e-5

    monkeypatch.setattr(time, "perf_counter", lambda: now_s)
    counts: list[int] = []
    seconds = each_of({"some": counts.append, "others": slow}, 1_000, rounds=1)
    assert counts == [1_000] * 2
    assert seconds["others"] == pytest.approx(1e-5)


def test_a_bar_holds_on_its_side_of_the_limit() -> None:
    """A value exactly at the limit holds; the line names the side of the limit."""
    assert Bar("cost", 25.0, 25.0, " us").holds
    assert not Bar("cost", 25.1, 25.0, " us").holds
    assert Bar("gain", 8.0, 8.0, at_least=True).holds
    assert str(Bar("gain", 7.5, 8.0, at_least=True)) == "gain: 7.5, at least 8: **fails**"
    assert str(Bar("cost", 20.0, 25.0, " us")) == "cost: 20 us, at most 25 us: holds"


def test_a_table_lists_its_bars_and_what_was_not_measured() -> None:
    """Both come below the rows of the table."""
    text = str(Table("Speed", ("who", "ms"), [["we", "1"]], [Bar("we", 1, 2)], ["they: not installed"]))
    assert text.splitlines()[2:5] == ["| who | ms |", "| --- | --- |", "| we | 1 |"]
    assert text.endswith("- we: 1, at most 2: holds\n- not measured: they: not installed\n")


def test_an_unknown_table_is_refused() -> None:
    """The exit code is 2, and the last line lists the known names."""
    command = [sys.executable, "-m", "benchmarks", "planer"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert (
        "table 'planer' is not one of planner, decision, bounds, wire, load, attacks, start"
        in done.stderr.splitlines()[-1]
    )
