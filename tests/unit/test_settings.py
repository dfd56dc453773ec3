"""The options of `Offloader.connect`, and what is built from them."""

import dataclasses
import inspect
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
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
            memories=settings.make_memories(name),
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
    ("given", "says"),
    [
        ({"duplicates": 1.5}, "duplicates: 1.5 is above 1, the maximum"),
        ({"duplicates": -0.1}, "duplicates: -0.1 is below 0, the minimum"),
        ({"duplicates": math.nan}, "duplicates: nan is below 0, the minimum"),
        ({"joules_a_minute": -1.0}, "joules_a_minute: -1.0 is below 0, the minimum"),
        ({"bytes_a_minute": math.nan}, "bytes_a_minute: nan is below 0, the minimum"),
        ({"s_per_quality": -1.0}, "s_per_quality: -1.0 is below 0, the minimum"),
        ({"window": 1}, "window: 1 is below 2, the minimum"),
    ],
)
def test_a_wrong_setting_is_an_error_at_once(given: dict[str, Any], says: str) -> None:
    """The error names the setting, its value and the limit."""
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}$"):
        Settings(**given)


def test_an_unknown_predictor_is_an_error_of_connect() -> None:
    """The error names the predictor before any task runs."""
    with pytest.raises(ConfigError, match="'part' is not one of"):
        Offloader.connect(settings=Settings(predictor="part"))


WRONG = [
    ({"endpoint": 5}, "endpoint 5: must be a string or None"),
    (
        {"sites": ["tcp://h:1"]},
        "sites ['tcp://h:1']: must be a dictionary of strings or a path or a string or None",
    ),
    (
        {"sites": {"edge": 5}},
        "sites {'edge': 5}: must be a dictionary of strings or a path or a string or None",
    ),
    ({"policy": None}, "policy None: must be a string"),
    ({"timeout_s": "3"}, "timeout_s '3': must be a number"),
    ({"timeout_s": True}, "timeout_s True: must be a number"),
    ({"timeout_s": None}, "timeout_s None: must be a number"),
    ({"keys": 5}, "keys 5: must be a path or a string or None"),
    ({"observers": print}, "observers <built-in function print>: must be a list of functions"),
    ({"observers": [5]}, "observers [5]: must be a list of functions"),
    ({"observers": "print"}, "observers 'print': must be a list of functions"),
    ({"metrics": 9100}, "metrics 9100: must be a string or None"),
    ({"trace": 5}, "trace 5: must be a path or a string or None"),
    ({"observe": 1}, "observe 1: must be True or False"),
    ({"settings": {"seed": 1}}, "settings {'seed': 1}: must be Settings or None"),
]
WRONG_SETTINGS = [
    ({"predictor": 5}, "predictor 5: must be a string or None"),
    ({"window": "5"}, "window '5': must be a whole number"),
    ({"window": 5.0}, "window 5.0: must be a whole number"),
    ({"heartbeats": "yes"}, "heartbeats 'yes': must be True or False or None"),
    ({"objective": "p95"}, "objective 'p95': must be Objective"),
    ({"s_per_quality": "1"}, "s_per_quality '1': must be a number"),
    ({"energy": 5.0}, "energy 5.0: must be Energy"),
    ({"duplicates": "0.1"}, "duplicates '0.1': must be a number"),
    ({"bytes_a_minute": "1"}, "bytes_a_minute '1': must be a number or None"),
    ({"joules_a_minute": []}, "joules_a_minute []: must be a number or None"),
    ({"memory": 5}, "memory 5: must be a path or a string or None"),
    ({"states": 5}, "states 5: must be TaskStates or None"),
    ({"compress": "no"}, "compress 'no': must be True or False"),
    ({"insecure": 1}, "insecure 1: must be True or False"),
    ({"known": 4.0}, "known 4.0: must be a whole number"),
    ({"reread_s": "2"}, "reread_s '2': must be a number"),
    ({"seed": "1"}, "seed '1': must be a whole number"),
    ({"tokens": "x"}, "tokens 'x': must be a dictionary of strings"),
    ({"convert": "x"}, "convert 'x': must be a dictionary"),
]


@pytest.mark.parametrize(("given", "says"), WRONG)
def test_a_wrong_type_is_one_error_of_connect(given: dict[str, Any], says: str) -> None:
    """The error names the parameter, its value and what is allowed."""
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}$"):
        Offloader.connect(**given)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"keys": "k"}, "keys: k needs an endpoint, the server to use"),
        ({"keys": Path("k"), "sites": {}}, "keys: k needs an endpoint, the server to use"),
        ({"endpoint": ""}, "cloud: '' is not tcp://HOST:PORT with a port 1 to 65535"),
        (
            {"endpoint": "tcp://h:1", "sites": {"cloud": "tcp://h:2"}},
            "sites: 'cloud' is the name of the server at tcp://h:1; choose another one",
        ),
    ],
)
def test_a_missing_or_ambiguous_server_is_one_error_of_connect(given: dict[str, Any], says: str) -> None:
    """Keys without a server, an empty endpoint, or two servers of one name are not what the user meant."""
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}$"):
        Offloader.connect(**given)


@pytest.mark.parametrize(("given", "says"), WRONG_SETTINGS)
def test_a_wrong_type_is_one_error_of_the_settings(given: dict[str, Any], says: str) -> None:
    """Settings are checked when they are made."""
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}$"):
        Settings(**given)


def test_every_parameter_is_checked() -> None:
    """The lists above have every parameter of `connect` and every setting."""
    assert {name for given, _ in WRONG for name in given} == set(
        inspect.signature(Offloader.connect).parameters
    )
    fields = {field.name for field in dataclasses.fields(Settings)}
    assert {name for given, _ in WRONG_SETTINGS for name in given} == fields


def test_right_types_are_taken(tmp_path: Path) -> None:
    """Paths may be strings, and numbers may be those of numpy."""
    memory, trace = tmp_path / "memory.json", tmp_path / "trace.jsonl"
    settings = Settings(memory=str(memory), window=np.int16(5), duplicates=np.float32(0.1), seed=np.int64(3))  # type: ignore[arg-type]
    observers: Any = (record for record in [print])
    with Offloader.connect(
        timeout_s=3,
        trace=str(trace),
        settings=settings,
        observers=observers,  # type: ignore[arg-type]
    ) as offload:
        assert offload(echo, 2) == 2
    assert memory.exists()
    assert trace.exists()
