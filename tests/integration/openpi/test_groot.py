"""Sites that speak the protocol of GR00T: both encodings, tokens, a killed server, and hostile answers."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from offboard import CloudBroken, ConfigError, Offloader, Settings, task
from offboard.policy_client import PolicyClient
from offboard.robot_client.policy_servers.groot import Groot, GrootCall, array_of
from offboard.robot_client.sites.runner import ONBOARD
from tests.integration.openpi.conftest import GrootServer, free_port
from tests.integration.openpi.robot import until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

STATE = np.arange(3, dtype=np.float32)
BAD = ("object", "header", "length", "shape", "dtype", "map object", "nan", "large")
MEMORY_MIB_MAX = 256  # as docs/policy_servers.md says
START_S = 20.0
BACK_S = 3.0


@task(
    "groot_act",
    policy_server=True,
    size=lambda _: 1.0,
    variants={"cloud": None},
    quality={"onboard": 0.2, "cloud": 1.0},
)
def act(observation: dict[str, Any]) -> Any:
    return {"action": np.asarray(observation["state"]) * 2}, {"by": "onboard"}


@pytest.fixture
def offload() -> Iterator[Callable[..., Offloader]]:
    made: list[Offloader] = []

    def connect(server: GrootServer, **options: Any) -> Offloader:
        made.append(Offloader.connect(sites={"gpu": server.endpoint}, **options))
        return made[-1]

    yield connect
    for one in made:
        one.close()


@pytest.mark.parametrize("dialect", ["npy", "maps"])
def test_a_site_answers_in_either_encoding(
    groot: Callable[..., GrootServer], offload: Callable[..., Offloader], dialect: str
) -> None:
    """The robot finds out which one it is; after a kill onboard answers, and the server is used again."""
    server = groot(dialect)
    robot = offload(server)
    assert robot.wait_for_sites(act, START_S) == {}
    for _ in range(20):
        (action, info), record = robot.call(act, {"state": STATE}, timeout_s=1.0)
        assert action["action"].tolist() == [0.0, 2.0, 4.0]
    assert (record.used, info) == ("gpu", {"options": None})
    server.kill()
    for _ in range(5):
        assert robot.call(act, {"state": STATE}, timeout_s=1.0)[1].used == ONBOARD
    server.start()
    until(lambda: robot.sites["gpu"].connected)
    began_s = time.monotonic()
    while robot.call(act, {"state": STATE}, timeout_s=1.0)[1].used != "gpu":
        assert time.monotonic() - began_s < BACK_S


@pytest.mark.parametrize("bad", BAD)
def test_a_hostile_answer_is_refused_with_one_line(
    groot: Callable[..., GrootServer], offload: Callable[..., Offloader], bad: str
) -> None:
    """Nothing is unpickled, a header of a gigabyte is not read, and onboard answers."""
    robot = offload(groot())
    assert robot.wait_for_sites(act, START_S) == {}
    (action, _), record = robot.call(act, {"bad": bad, "state": STATE}, where="gpu", timeout_s=5.0)
    assert record.used == ONBOARD
    assert action["action"].tolist() == [0.0, 2.0, 4.0]
    (error,) = [one.error for one in record.executions if one.site == "gpu"]
    assert error.startswith("CloudBroken: ")
    assert "\n" not in error


def test_hostile_answers_take_little_memory(groot: Callable[..., GrootServer]) -> None:
    """For none of them the robot holds more than MEMORY_MIB_MAX, nor for the most items allowed."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.integration.openpi.hostile_memory", groot().endpoint, *BAD, "items"],
        capture_output=True, text=True, check=True, timeout=90,
    )  # fmt: skip
    held = {kind: float(mib) for kind, _, mib in (line.rpartition(" ") for line in done.stdout.splitlines())}
    assert list(held) == [*BAD, "items"]
    assert 16 < held["items"] < MEMORY_MIB_MAX


def test_a_frozen_server_costs_one_answer(
    groot: Callable[..., GrootServer], offload: Callable[..., Offloader]
) -> None:
    """Its answer is late, then it is silent, and it is used again when it goes on."""
    server = groot()
    robot = offload(server)
    assert robot.wait_for_sites(act, START_S) == {}
    robot(act, {"state": STATE}, where="gpu")
    server.signal(signal.SIGSTOP)
    used = [robot.call(act, {"state": STATE}, timeout_s=0.2)[1].used for _ in range(10)]
    server.signal(signal.SIGCONT)
    assert set(used[1:]) == {ONBOARD}
    began_s = time.monotonic()
    while robot.call(act, {"state": STATE}, timeout_s=0.5)[1].used != "gpu":
        assert time.monotonic() - began_s < 2 * BACK_S


def test_a_token_comes_from_a_private_file(
    groot: Callable[..., GrootServer],
    offload: Callable[..., Offloader],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """With mode 600 it is sent, and the log says that the connection is plain; others may not read it."""
    server, file = groot(token="a-secret"), tmp_path / "gpu.token"
    file.write_text("a-secret\n")
    file.chmod(0o644)
    with pytest.raises(ConfigError, match=r"gpu.token has mode 0644"):
        offload(server, keys=tmp_path)
    file.chmod(0o600)
    robot = offload(server, keys=tmp_path)
    assert robot.wait_for_sites(act, START_S) == {}
    assert "its token is sent over a plain connection" in caplog.text
    assert "a-secret" not in caplog.text
    without = offload(server)
    until(lambda: "Unauthorized" in str(without.wait_for_sites(act, 0).get("gpu")))


def test_the_client_of_groot_needs_one_changed_import(groot: Callable[..., GrootServer]) -> None:
    """Its methods do what those of the original do; without a server an error names the cause."""
    server = groot()
    with PolicyClient("127.0.0.1", server.port, timeout_ms=2000) as client:
        assert client.ping()
        action, info = client.get_action({"state": STATE}, {"seed": 4})
        assert (action["action"].tolist(), info) == ([0.0, 2.0, 4.0], {"options": {"seed": 4}})
        assert client.reset() == {"resets": 1}
        assert client.get_modality_config() == {"state": {"delta_indices": [0]}}
        server.kill()
        with pytest.raises(CloudBroken, match=r"no policy server has answered: "):
            client.get_action({"state": STATE})
        until(lambda: not client.ping())
        with pytest.raises(CloudBroken, match=r"no policy server has answered: none is there"):
            client.get_action({"state": STATE})


def test_the_client_of_groot_has_an_onboard_policy(groot: Callable[..., GrootServer]) -> None:
    """It answers when the server is killed."""
    server = groot()
    onboard = lambda observation: {"action": observation["state"] * 3}  # noqa: E731
    with PolicyClient("127.0.0.1", server.port, onboard=onboard, deadline_s=1.0) as client:
        until(lambda: client.get_action({"state": STATE})[0]["action"].tolist() == [0.0, 2.0, 4.0])
        server.kill()
        for _ in range(5):
            action, info = client.get_action({"state": STATE})
            assert (action["action"].tolist(), info) == ([0.0, 3.0, 6.0], {})


@pytest.mark.parametrize("dialect", ["npy", "maps"])
def test_the_gateway_serves_clients_of_groot(
    groot: Callable[..., GrootServer], dialect: str, tmp_path: Path
) -> None:
    """Through a REQ socket: the answer of a server byte for byte, and that of onboard when it is killed."""
    server, port = groot(dialect), free_port()
    (tmp_path / "onboard.py").write_text("def act(seen):\n    return {'action': seen['state'] * 2}\n")
    command = [sys.executable, "-m", "offboard.robot_client", "gateway", "--onboard=onboard:act"]
    flags = [f"--listen=groot://127.0.0.1:{port}", f"--site=gpu={server.endpoint}", "--deadline=0.5"]
    root = str(Path(__file__).parents[3])
    door = subprocess.Popen([*command, *flags], cwd=tmp_path, env={**os.environ, "PYTHONPATH": root})
    packed = Groot("")
    packed._tries_maps = dialect == "maps"
    request = packed.pack({"state": STATE})
    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.RCVTIMEO, int(1000 * START_S))
        client.connect(f"tcp://127.0.0.1:{port}")

        def ask(data: bytes) -> bytes:
            client.send(data)
            return client.recv()

        def action() -> Any:
            return packed.read(ask(request))

        assert packed.read(ask(packed.pack(GrootCall("ping"))))["status"] == "ok"
        until(lambda: action()[1] == {"options": None})
        with zmq.Context() as direct, direct.socket(zmq.REQ) as own:
            own.connect(f"tcp://127.0.0.1:{server.port}")
            own.send(request)
            assert ask(request) == own.recv()
        assert packed.read(ask(packed.pack(GrootCall("reset", {"options": None})))) == {"resets": 1}
        with pytest.raises(CloudBroken, match="endpoint 'kill': the gateway answers ping"):
            packed.read(ask(packed.pack(GrootCall("kill"))))
        server.kill()
        for _ in range(5):
            found, info = action()
            assert (found["action"].tolist(), info) == ([0.0, 2.0, 4.0], {})
    door.send_signal(signal.SIGTERM)
    assert door.wait(START_S) == 0


def test_a_plain_server_elsewhere_needs_insecure() -> None:
    """As ws:// does."""
    with pytest.raises(ConfigError, match=r"groot://10.0.0.1:5555' is not encrypted"):
        Offloader.connect(sites={"gpu": "groot://10.0.0.1:5555"})
    Offloader.connect(sites={"gpu": "groot://10.0.0.1:5555"}, settings=Settings(insecure=True)).close()


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 3)),
        np.float32(2.5),
        np.arange(6).reshape(2, 3),
        np.asfortranarray(np.ones((2, 3))),
        STATE > 1,
    ],
)
def test_arrays_cross_unchanged(array: Any) -> None:
    """In both directions, in the order of their memory, read-only."""
    packed = Groot("groot://127.0.0.1:1").pack({"state": np.asarray(array)})
    start = packed.index(b"\x93NUMPY")
    found = array_of(packed[start : start + 128 + np.asarray(array).nbytes])
    assert found.dtype == np.asarray(array).dtype
    assert np.array_equal(found, array)
    assert not found.flags.writeable
