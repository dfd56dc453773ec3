"""Simulating sets of scenarios for a comparison: which ones, with which seeds, and what is compared."""

import re
import shutil
from pathlib import Path

import pytest

from benchmarks import against_simulated
from benchmarks.against import HERE
from benchmarks.simulated_sets import (
    FRESH,
    SHIPPED,
    UNSEEN,
    Checkout,
    ScenarioSet,
    by_scenario,
    differences,
    scenario_sets,
    simulate,
    table,
)
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped
from offboard.loadgen.simulation.simulated_testbed import check_simulated

BASE = {(name, seed): 1.0 + 0.01 * seed for name in ("calm", "outage") for seed in range(1, 7)}
WORSE = {pair: value + (0.1 if pair[0] == "outage" else 0.0) for pair, value in BASE.items()}


def test_the_sets_hold_what_can_be_simulated() -> None:
    """Applications, bursts and runs on both sites are left out; the fresh set differs in its seeds alone."""
    sets = scenario_sets()
    names = [path.stem for path in sets[SHIPPED].scenarios]
    assert {"calm", "outage", "heavy-tail"} <= set(names)
    assert not {"apriltags-calm", "burst", "soak", "paper", "demo"} & set(names)
    assert sets[FRESH].scenarios == sets[SHIPPED].scenarios
    assert sets[FRESH].first_seed is not None


@pytest.mark.parametrize("path", sorted(UNSEEN.glob("*.toml")), ids=lambda path: path.stem)
def test_the_unseen_scenarios_can_be_simulated(path: Path) -> None:
    """Their name is that of their file, and no shipped scenario has it."""
    scenario = read_scenario(path)
    check_simulated(scenario)
    assert scenario.name == path.stem
    assert path.stem not in shipped()


def test_a_scenario_is_written_for_an_older_checkout(tmp_path: Path) -> None:
    """Name, seed and the module of the task change, and the map is found from anywhere."""
    (tmp_path / "loadgen" / "scenarios").mkdir(parents=True)
    (tmp_path / "loadgen" / "scenarios" / "heavy-tail.toml").write_text(
        'task = "loadgen.work:hash_rarely_long"\n'
    )
    old = Checkout(tmp_path)
    assert (old.module, Checkout(HERE).module) == ("loadgen", "offboard.loadgen")
    text = old.text(find_scenario("heavy-tail"), "heavy-tail-7", 7)
    assert re.findall(r'(?m)^(?:name = "heavy-tail-7"|seed = 7|task = "loadgen.work:.*")$', text)[2:]
    file = tmp_path / "calm-8.toml"
    file.write_text(Checkout(HERE).text(find_scenario("calm"), "calm-8", 8))
    ours = read_scenario(find_scenario("calm"))
    assert read_scenario(file).workload == ours.workload
    assert read_scenario(file).seed == 8


def test_differences_are_paired() -> None:
    """The same seeds are compared, so that what they have in common does not widen the interval."""
    mean, largest = differences(WORSE, BASE)
    assert re.fullmatch(r"\+0\.0500 \[\+0\.0[12].*, \+0\.0[78].*\]", mean)
    assert largest == "+0.100 (outage)"
    assert by_scenario(BASE) == pytest.approx({"calm": 1.035, "outage": 1.035})


def test_a_table_shows_mean_and_worst() -> None:
    """The base is compared with nothing."""
    rows = table("shipped", {"before": BASE, "after": WORSE}, "before").rows
    assert rows[0] == ["before", "1.035", "1.035 (calm)", "", ""]
    assert rows[1][:3] == ["after", "1.085", "1.135 (outage)"]


def test_only_large_differences_are_listed() -> None:
    """A scenario within the limit is no line of the list."""
    rows = against_simulated.far_apart("shipped", {"before": BASE, "after": WORSE, "paper": BASE}).rows
    assert rows == [["outage", "1.035", "1.135", "1.035", "+0.100"]]


def test_a_scenario_is_simulated_once(tmp_path: Path) -> None:
    """The second time its figures come from the file; other seeds are simulated again."""
    calm = ScenarioSet([find_scenario("calm")], seeds=1)
    first = simulate(Checkout(HERE), calm, ["onboard"], tmp_path / "a", flags=["--jobs", "1"])
    assert first["onboard"]["calm", 1] > 1.0
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    kept = tmp_path / "b" / "calm.json"
    kept.write_text(kept.read_text().replace(str(first["onboard"]["calm", 1]), "9.0"))
    again = simulate(Checkout(HERE), calm, ["onboard"], tmp_path / "b", flags=["--jobs", "1"])
    assert again["onboard"] == {("calm", 1): 9.0}
    more = simulate(
        Checkout(HERE),
        ScenarioSet(calm.scenarios, seeds=2),
        ["onboard"],
        tmp_path / "b",
        flags=["--jobs", "1"],
    )
    assert more["onboard"]["calm", 1] == first["onboard"]["calm", 1]


def test_wrong_names_are_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong set, scenario, number of seeds or checkout gives exit code 2, and says what is allowed."""
    for wrong, said in (
        (["--sets", "new"], "'new' is not one of shipped, fresh, unseen"),
        (["--scenarios", "clam"], "'clam' is not one of "),
        (["--seeds", "0"], "--seeds: 0 is below 1"),
    ):
        monkeypatch.setattr("sys.argv", ["against_simulated", str(HERE), *wrong])
        with pytest.raises(SystemExit) as stopped:
            against_simulated.main()
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.setattr("sys.argv", ["against_simulated", "nowhere"])
    with pytest.raises(SystemExit):
        against_simulated.main()
    assert "nowhere is no checkout of Offboard" in capsys.readouterr().err
