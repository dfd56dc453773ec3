"""Endpoints of policy servers: which are allowed, and which need --insecure."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from offboard import Offloader, Settings
from offboard.common.errors import ConfigError
from offboard.common.tasks import task
from offboard.common.variants import QUALITY_OF_POLICY_SERVER
from offboard.robot_client.sites.endpoint import check_policy_server, check_site, is_readable
from tests.extras import needs

ROOT = Path(__file__).parents[2]
ALLOWED = [
    "ws://127.0.0.1:8000",
    "ws://localhost:8000/",
    "ws://[::1]:8000/v1/realtime/robot/openpi",
    "wss://gpu.example:443/openpi?model=pi0",
    "wss://gpu.example",
    "wss://192.0.2.1:65535",
]
OPEN = ["ws://192.0.2.1:8000", "ws://gpu:8000", "ws://gpu/v1", "ws://[2001:db8::1]:8000"]
WRONG = [
    "ws://",
    "ws://:8000",
    "ws://gpu:0",
    "ws://gpu:65536",
    "ws://gpu:eight",
    "wss://user:secret@gpu:8000",
    "wss://gpu:8000 /x",
    "wss://gpu:8000/a#b",
    "http://gpu:8000",
]


@pytest.mark.parametrize("endpoint", ALLOWED)
def test_loopback_and_encryption_need_no_flag(endpoint: str) -> None:
    """A path may follow, and the port may be left out."""
    check_policy_server("--site gpu", endpoint, insecure=False)
    check_site("--site gpu", endpoint, insecure=False)
    assert not is_readable(endpoint)


@pytest.mark.parametrize("endpoint", OPEN)
def test_plain_text_beyond_loopback_needs_a_flag(endpoint: str) -> None:
    """The error names both remedies."""
    with pytest.raises(ConfigError, match=r"^--site gpu: .* is not encrypted; use wss://, .* --insecure"):
        check_site("--site gpu", endpoint, insecure=False)
    check_site("--site gpu", endpoint, insecure=True)
    assert is_readable(endpoint)


@pytest.mark.parametrize("endpoint", WRONG)
def test_anything_else_is_refused(endpoint: str) -> None:
    """One line says what is allowed."""
    with pytest.raises(ConfigError, match="is not ws://HOST:PORT or wss://HOST:PORT with a port 1 to 65535"):
        check_policy_server("gpu", endpoint, insecure=True)


def test_connect_asks_for_the_setting() -> None:
    """Nothing is opened before the endpoints are checked."""
    pytest.importorskip("websockets", reason="needs the extra 'openpi': pip install '.[openpi]'")
    with pytest.raises(
        ConfigError, match=r"^gpu: 'ws://192.0.2.1:8000' is not encrypted.*Settings\(insecure"
    ):
        Offloader.connect(sites={"gpu": "ws://192.0.2.1:8000"}, settings=Settings(memory=None))


def test_a_task_of_a_policy_server_has_one_argument() -> None:
    """It is the observation; a setup comes before it."""

    @task("openpi_with_setup", policy_server=True, setup=dict, size=len)
    def with_setup(model: dict[str, int], observation: dict[str, int]) -> dict[str, int]:
        return model | observation

    for function in (lambda: None, lambda a, b: (a, b), lambda *many: many):
        with pytest.raises(ConfigError, match="policy_server=True needs a function of one argument"):
            task("openpi_other", policy_server=True, size=len)(function)


@pytest.mark.parametrize(
    "given",
    [
        {"quality": {"onboard": 0.7, "gpu": 1.0}},
        {"variants": {"cloud": None}},
        {"variants": {"gpu": None}, "quality": {"onboard": 0.7, "gpu": 1.0}},
        {"variants": {"cloud": None}, "quality": {"onboard": 0.7}},
    ],
    ids=["no variants", "no quality", "no cloud", "no quality of cloud"],
)
def test_a_refused_quality_says_how_to_give_it(given: dict[str, Any]) -> None:
    """A policy server has no function on this robot, so its quality is given in a way of its own."""
    with pytest.raises(ConfigError, match=re.escape(QUALITY_OF_POLICY_SERVER)):
        task("openpi_graded", policy_server=True, size=len, **given)(len)
    with pytest.raises(ConfigError) as caught:  # other tasks need no word of policy servers
        task("openpi_graded", size=len, **given)(len)
    assert "policy server" not in str(caught.value)


def test_without_its_library_one_line_names_the_extra() -> None:
    """Where websockets is absent, connecting to a policy server is a MissingExtra."""
    block = (
        "import sys\n"
        "sys.modules['websockets'] = None\n"
        "from offboard import MissingExtra, Offloader\n"
        "try:\n"
        "    Offloader.connect(sites={'gpu': 'ws://127.0.0.1:1'})\n"
        "except MissingExtra as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.stdout == (f"{needs('a policy server (ws:// or wss://)', 'openpi')}\n"), done.stderr
