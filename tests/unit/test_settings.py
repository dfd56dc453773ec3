"""The options of `Offloader.connect`, and what is built from them."""

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import pytest

from offboard import Offloader, Settings
from offboard.common.errors import ConfigError
from offboard.common.tasks import task
from offboard.robot_client.policies import Hedge, Outlook, Probe
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner

PARAMETERS_MAX = {"__init__": 8, "connect": 10}


@task("settings_echo", size=lambda number: number)
def echo(number: int) -> int:
    return number


@pytest.mark.parametrize("build", [Offloader.__init__, Offloader.connect], ids=["Offloader", "connect"])
def test_an_offloader_is_built_with_few_parameters(build: Any) -> None:
    """Rare options are in Settings, so that the common ones are easy to see."""
    assert len(inspect.signature(build).parameters.keys() - {"self"}) <= PARAMETERS_MAX[build.__name__]


@pytest.mark.parametrize(
    ("value", "field"),
    [(Settings(), "seed"), (Outlook(), "age"), (Probe("cloud"), "site"), (Hedge("cloud", 0.1), "after_s")],
)
def test_values_cannot_be_changed(value: Any, field: str) -> None:
    """Settings, outlooks, probes and hedges stay as they were made."""
    with pytest.raises((AttributeError, dataclasses.FrozenInstanceError)):
        setattr(value, field, 1)


def test_settings_take_keywords_only() -> None:
    """A setting is never given by its position."""
    with pytest.raises(TypeError):
        Settings("parts")  # type: ignore[misc]


def test_each_allowance_is_a_fresh_one() -> None:
    """Two offloaders with the same settings do not share what they may spend."""
    settings = Settings(bytes_a_minute=1000.0)
    first, second = settings.allowance(), settings.allowance()
    first.spend(900.0, 0.0)
    assert (first.bytes_left, second.bytes_left) == (100.0, 1000.0)
    assert not Settings().allowance().capped


@pytest.mark.parametrize("name", ["default", "hedge:probe:greedy", "paper"])
def test_a_record_has_the_policy_as_the_user_named_it(name: str) -> None:
    """This holds with caps too. Pinned calls, batches and robots without a server have names of their own."""
    settings, policies = Settings(bytes_a_minute=1e9), list[str]()
    cloud = ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.01, one.args[0]))
    for sites in ([cloud], []):
        with Offloader(
            [*sites, OnboardRunner()],
            policy=settings.make_policy(name),
            memories=settings.make_memories(name, 5),
            observers=[lambda record: policies.append(record.decision.policy)],
        ) as offload:
            offload(echo, 1)
            offload(echo, 1, where=ONBOARD)
            offload.map(echo, [1])
    assert policies == [name, "pinned", "map", "none", "pinned", "none"]


def test_connect_uses_its_settings(tmp_path: Path) -> None:
    """What was learnt is in the memory file, and `default` is a policy name as any other."""
    path = tmp_path / "memory.json"
    settings = Settings(memory=path, bytes_a_minute=1e6, predictor="parts", seed=3)
    with Offloader.connect(policy="default", settings=settings) as offload:
        assert offload(echo, 2) == 2
    assert "settings_echo" in path.read_text()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (Settings(predictor="part"), "'part' is not one of"),
        (Settings(duplicates=1.5), "must be a share of tasks"),
        (Settings(joules_a_minute=-1.0), "must be 0 or more"),
    ],
)
def test_a_wrong_setting_is_an_error_of_connect(settings: Settings, says: str) -> None:
    """The error names the setting before any task runs."""
    with pytest.raises(ConfigError, match=says):
        Offloader.connect(settings=settings)
