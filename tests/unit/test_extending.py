"""The predictor and the policy of docs/extending.md, used by the path of their class as a reader would."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from offboard.common.config import find_class
from offboard.common.errors import ConfigError, MissingExtra
from offboard.loadgen.scenario.scenario import RobotPart
from offboard.loadgen.scenario.scenario_file import read_scenario
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies.hedge import WithHedges
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests import checks, policy_checks
from tests.outlooks import decide, known

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
MODULE = "\n".join(re.findall(r"```python\n(# mymodels\.py\n.*?)```", PAGE, re.DOTALL))
SMALL = """name = "small"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["uniform:1000:30000"]
tasks = 10
"""
CONSTANT, BY_SIZE = "mymodels.Constant", "mymodels.BySize"


@pytest.fixture(autouse=True)
def mymodels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The code of the page as a module, next to one that cannot be imported."""
    (tmp_path / "mymodels.py").write_text(MODULE)
    (tmp_path / "broken.py").write_text("import nothing_of_this_name\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in ("mymodels", "needy"):
        sys.modules.pop(name, None)


def test_the_predictor_keeps_the_contract_but_for_two_checks() -> None:
    """As the page says, it neither refuses times that are no numbers nor learns a line."""
    failed = []
    for check in (*checks.CONTRACT, *checks.WINDOWED):
        try:
            check(lambda: predictors.make(CONSTANT, checks.WINDOW))
        except (AssertionError, pytest.fail.Exception):
            failed.append(check)
    assert failed == [checks.refuses_bad_observations]
    with pytest.raises(AssertionError):
        checks.learns_a_line(lambda: predictors.make(CONSTANT, checks.WINDOW), 0.05)


def test_the_policy_keeps_the_contract() -> None:
    """Every check of the contract holds for it, alone and inside a wrapper."""
    for name in (BY_SIZE, f"hedge:{BY_SIZE}"):
        for check in policy_checks.CONTRACT:
            check(lambda name=name: policies.make(name, seed=3))


def test_a_rule_of_a_user_is_named_like_any_other() -> None:
    """Wrappers go in front of it, its class says which predictor it is meant for, and heartbeats are sent."""
    assert isinstance(policies.make(f"hedge:{BY_SIZE}"), WithHedges)
    assert policies.predictor_of(f"hedge:{BY_SIZE}") == predictors.LEAST_SQUARES
    assert policies.heartbeats(BY_SIZE)
    assert policies.weighs_cost(BY_SIZE)
    assert decide(BY_SIZE, {ONBOARD: known(0.5), CLOUD: known(0.1)}).site == ONBOARD


def test_settings_and_scenarios_take_the_path() -> None:
    """A robot is made with it, and `loadgen` hands it to a robot as it is."""
    settings = Settings(predictor=CONSTANT)
    assert settings.make_memories(BY_SIZE)
    assert settings.make_policy(BY_SIZE)
    assert RobotPart(policy=f"probe:{BY_SIZE}", predictor=CONSTANT).names() == (f"probe:{BY_SIZE}", CONSTANT)


def test_a_rival_and_a_class_of_a_user_play_a_scenario(tmp_path: Path) -> None:
    """In simulation, a scenario is played with short names and with paths."""
    pytest.importorskip("sklearn", reason="scikit-learn is not installed: `make install`")
    (tmp_path / "small.toml").write_text(SMALL)
    scenario = read_scenario(tmp_path / "small.toml")
    strategies = {
        "rivals": {"policy": "hedge:greedy", "predictor": "k-means"},
        "user's": {"policy": BY_SIZE, "predictor": CONSTANT},
    }
    with SimulationPool(1) as pool:
        played = pool.play([scenario], strategies)
    assert {name: len(runs[0].answered) for name, runs in played.items()} == {"rivals": 10, "user's": 10}


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("mymodels.Constants", "module 'mymodels' has no class 'Constants'"),
        ("mymodels.LARGE", "module 'mymodels' has no class 'LARGE'"),
        ("mymodel.Constant", "module 'mymodel' cannot be imported: ModuleNotFoundError: "),
        ("broken.Constant", "'broken' cannot be imported: ModuleNotFoundError: No module named 'nothing_of"),
        (".Constant", "module '' cannot be imported: ValueError: "),
        ("mymodels.", "module 'mymodels' has no class ''"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused(path: str, said: str) -> None:
    """One line names the path and what is wrong with it, for a predictor and for a policy."""
    for make, what in (
        (lambda: predictors.make(path, 5), "predictor"),
        (lambda: policies.make(path), "policy"),
    ):
        with pytest.raises(ConfigError) as refused:
            make()
        assert str(refused.value).startswith(f"{what} {path!r}: ")
        assert said in str(refused.value)
        assert "\n" not in str(refused.value)


def test_a_missing_extra_stays_one(tmp_path: Path) -> None:
    """If the module of a class needs an extra, the error is the one that names it."""
    (tmp_path / "needy.py").write_text(
        "from offboard import MissingExtra\nraise MissingExtra('predictor needy', 'learned')\n"
    )
    with pytest.raises(MissingExtra, match="needs the extra 'learned'"):
        find_class("needy.Needy", "predictor")
