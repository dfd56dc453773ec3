"""How benchmarks measure and judge; what they measure is run by `make bench`."""

import subprocess
import sys
import time

from benchmarks.measure import Bar, Table, each_of, interleaved


def test_every_case_runs_as_often_in_turning_order() -> None:
    """Once in each round, every other one backwards, and once more before the first."""
    ran: list[str] = []
    seconds = interleaved({name: lambda name=name: ran.append(name) for name in "abc"}, rounds=3)
    assert "".join(ran) == "cbaabccbaabc"
    assert seconds.keys() == set("abc")


def test_of_many_calls_the_time_of_one_is_told() -> None:
    """The case is told how many; its time is divided by that."""
    counts: list[int] = []
    one = {"some": counts.append, "others": lambda count: time.sleep(count * 1e-5)}
    seconds = each_of(one, 1_000, rounds=1)
    assert counts == [1_000] * 2
    assert seconds["others"] >= 1e-5


def test_a_bar_holds_on_its_side_of_the_limit() -> None:
    """At the limit too; the line says which side that is."""
    assert Bar("cost", 25.0, 25.0, " us").holds
    assert not Bar("cost", 25.1, 25.0, " us").holds
    assert Bar("gain", 8.0, 8.0, at_least=True).holds
    assert str(Bar("gain", 7.5, 8.0, at_least=True)) == "gain: 7.5, at least 8: **fails**"
    assert str(Bar("cost", 20.0, 25.0, " us")) == "cost: 20 us, at most 25 us: holds"


def test_a_table_says_what_is_missing() -> None:
    """Below its rows, with the bars."""
    text = str(Table("Speed", ("who", "ms"), [["we", "1"]], [Bar("we", 1, 2)], ["they: not installed"]))
    assert text.splitlines()[2:5] == ["| who | ms |", "| --- | --- |", "| we | 1 |"]
    assert text.endswith("- we: 1, at most 2: holds\n- not measured: they: not installed\n")


def test_a_wrong_name_is_one_line() -> None:
    """And exit code 2, with the names that there are."""
    command = [sys.executable, "-m", "benchmarks", "planer"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert (
        "table 'planer' is not one of planner, decision, bounds, wire, load, attacks, start"
        in done.stderr.splitlines()[-1]
    )
