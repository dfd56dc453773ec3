"""`loadgen checks`: the verdict of every check, in simulation."""

import json
from pathlib import Path

import pytest

from offboard.loadgen.__main__ import main
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from tests.mazes import warm
from tests.testbeds import MAP

warm()  # compiles before the clock of any test runs
CHECKS = ("checks", "outage", "--simulate", "--seeds", "2", "--jobs", "1")


def test_every_check_has_a_value_for_each_run(capsys: pytest.CaptureFixture[str]) -> None:
    """One line for each policy and check that needs no real process, with a value for each seed."""
    assert main([*CHECKS, "--policies", "default,cloud", "--format", "json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    checks = [one for one in read_scenario(find_scenario("outage")).checks if not FIGURES[one.figure].real]
    assert [(line["policy"], line["check"]) for line in table["scores"]] == [
        (policy, str(one)) for policy in ("default", "cloud") for one in checks
    ]
    verdicts = {(line["policy"], line["check"]): line["verdict"] for line in table["scores"]}
    for line in table["scores"]:
        one = next(one for one in checks if str(one) == line["check"])
        values = [float(line[f"run_{number}"]) for number in (1, 2)]
        low, high = one.at_least or float("-inf"), float("inf") if one.at_most is None else one.at_most
        failed = sum(not low <= value <= high for value in values)
        said = {0: "holds", 1: "**fails** in 1 of 2", 2: "**fails**"}[failed]
        assert verdicts[line["policy"], line["check"]] == said
    late = next(str(one) for one in checks if one.figure == "late_percent")
    assert verdicts["cloud", late] == "**fails**"  # as `fails_with` of that check says


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["checks", "paper"], "paper has no checks"),
        (["checks", "soak", "--simulate"], "soak"),
        (["checks", "calm", "--jobs", "2"], "--jobs: 2 needs --simulate"),
        (["checks", "calm", "--simulate", "--testbed", "docker"], "--testbed: docker cannot be combined"),
        (["checks", "calm", "--policies", "paper,paper"], "a policy is named twice"),
    ],
)
def test_a_wrong_flag_is_one_line(flags: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It gives exit code 2."""
    assert main(flags) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_checks_that_need_real_processes_cannot_be_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A scenario with no other checks is refused, instead of an empty table."""
    workload = f'map = "{MAP}"\ntasks = 20'
    scenario = tmp_path / "mine.toml"
    scenario.write_text(
        f'name = "mine"\nseed = 1\n[workload]\n{workload}\n[[check]]\nfigure = "overhead_ms"\nat_most = 0\n'
    )
    assert main(["checks", str(scenario), "--simulate", "--format", "csv"]) == 2
    assert "mine has no checks that a simulation can judge" in capsys.readouterr().err
