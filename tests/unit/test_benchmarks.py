"""How benchmarks measure and judge; `make bench` runs the measurements themselves."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from benchmarks import measure
from benchmarks.__main__ import TABLES
from benchmarks.measure import Requirement, Table, each_of, interleaved


def test_cases_run_equally_often_in_alternating_order() -> None:
    """Each round runs every case once, every other round in reverse order; one more round comes first."""
    ran: list[str] = []
    seconds = interleaved({name: lambda name=name: ran.append(name) for name in "abc"}, rounds=3)
    assert "".join(ran) == "cbaabccbaabc"
    assert seconds.keys() == set("abc")


def test_the_time_of_many_calls_is_divided_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """A case gets the number of calls to make, and its time is divided by this number."""
    counts: list[int] = []
    now_s = 0.0

    def wait(count: int) -> None:
        nonlocal now_s
        now_s += count * 0.5

    monkeypatch.setattr(measure, "time", SimpleNamespace(perf_counter=lambda: now_s))
    seconds = each_of({"none": counts.append, "some": wait}, 1_000, rounds=1)
    assert counts == [1_000] * 2
    assert seconds == {"none": 0.0, "some": 0.5}


def test_a_requirement_holds_on_its_side_of_the_limit() -> None:
    """It also holds at the limit itself, and its line says on which side the figure must be."""
    assert Requirement("cost", 25.0, 25.0, "us").holds
    assert not Requirement("cost", 25.1, 25.0, "us").holds
    assert Requirement("gain", 8.0, 8.0, at_least=True).holds
    assert str(Requirement("gain", 7.5, 8.0, at_least=True)) == "gain: 7.5, at least 8: **fails**"
    assert str(Requirement("cost", 20.0, 25.0, "us")) == "cost: 20 us, at most 25 us: holds"


def test_a_table_lists_what_was_not_measured() -> None:
    """The reasons are printed below the rows and the requirements."""
    requirements = [Requirement("we", 1, 2)]
    text = str(Table("Speed", ("who", "ms"), [["we", "1"]], requirements, missing=["they: not installed"]))
    assert text.splitlines()[2:5] == ["| who | ms |", "| --- | --- |", "| we | 1 |"]
    assert text.endswith("- we: 1, at most 2: holds\n- not measured: they: not installed\n")


def test_a_wrong_table_name_is_one_line() -> None:
    """A wrong name gives exit code 2 and a line with the known names."""
    command = [sys.executable, "-m", "benchmarks", "planer"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    known = ", ".join(TABLES)
    assert f"table 'planer' is not one of {known}" in done.stderr.splitlines()[-1]
