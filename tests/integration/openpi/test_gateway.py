"""The gateway and the drop-in client of openpi, with the servers and clients of others."""

import itertools
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from offboard import CloudBroken, ConfigError
from offboard.common.command_line import USAGE_EXIT
from offboard.policy_client import PolicyClient, WebsocketClientPolicy
from offboard.robot_client.policy_servers.openpi import pack, unpack
from tests.integration.openpi.bad_servers import says, serving
from tests.integration.openpi.conftest import GrootServer, PolicyServer
from tests.integration.openpi.robot import until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ONBOARD = """
import numpy as np
def act(observation):
    return {"actions": np.asarray(observation["state"], np.float32) * 2, "by": "onboard"}
class Groot:
    def observation(self, observation):
        return {"state": observation["state"]}
    def action(self, answer):
        return {"actions": answer[0]["action"], "by": "groot"}
class Openpi:
    def observation(self, observation):
        return {"state": observation["state"]}
    def action(self, answer):
        return {"action": answer["actions"]}, {"by": answer["by"]}
groot, openpi, none = Groot(), Openpi(), object()
"""
# An unchanged client of openpi: 200 observations, each of which has the right answer, in at most a second.
CLIENT = """
import sys, time
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
policy = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]))
by = set()
for number in range(200):
    began_s = time.monotonic()
    answer = policy.infer({"state": np.full(8, number, np.float32)})
    assert time.monotonic() - began_s < 1.0
    assert (answer["actions"] == 2 * number).all(), number
    by.add(answer["by"])
    time.sleep(0.01)
print(*sorted(by))
"""
START_S = 30.0
WAIT_S = 60.0
LATE_S = 0.1  # more than a server of these tests takes, on a loaded machine too
CHAOS_S = 600.0 if os.environ.get("CHAOS") == "1" else 6.0

Start = Callable[[], PolicyServer]


class Gateway:
    """`robot-client gateway` in a process."""

    def __init__(self, folder: Path, *flags: str, scheme: str = "ws") -> None:
        with socket.create_server(("127.0.0.1", 0)) as unused:
            self.port = unused.getsockname()[1]
        (folder / "onboard.py").write_text(ONBOARD)
        command = [sys.executable, "-m", "offboard.robot_client", "gateway"]
        listen = f"--listen={scheme}://127.0.0.1:{self.port}"
        path = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
        self.process = subprocess.Popen(
            [*command, listen, *flags], cwd=folder, stdout=subprocess.PIPE, text=True, env=path
        )
        assert self.process.stdout is not None
        assert "clients connect" in self.process.stdout.readline()

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=WAIT_S)
        return self.process.returncode


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Callable[..., Gateway]]:
    made: list[Gateway] = []

    def start(*flags: str, scheme: str = "ws") -> Gateway:
        made.append(Gateway(tmp_path, *flags, scheme=scheme))
        return made[-1]

    yield start
    for one in made:
        one.process.kill()
        one.process.communicate()


def test_an_unchanged_client_survives_killed_servers(
    third_party: Path, policy_server: Start, gateway: Callable[..., Gateway], tmp_path: Path
) -> None:
    """Both servers are killed and started again while it asks; each answer is right and in the trace."""
    servers = [policy_server(), policy_server()]
    sites = [f"--site={name}={one.endpoint}" for name, one in zip(("gpu", "near"), servers, strict=True)]
    door = gateway(*sites, "--onboard=onboard:act", "--deadline=0.5", "--trace=trace.jsonl")
    client = subprocess.Popen([third_party, "-c", CLIENT, str(door.port)], stdout=subprocess.PIPE, text=True)
    time.sleep(1.5)
    for one in servers:
        one.kill()
    time.sleep(0.5)
    for one in servers:
        one.start()
    out, _ = client.communicate(timeout=WAIT_S)
    assert (client.returncode, out.split()) == (0, ["gpu", "onboard"])
    assert door.end() == 0
    assert (tmp_path / "trace.jsonl").read_text().count("\n") == 200


def test_an_answer_goes_back_byte_for_byte(gateway: Callable[..., Gateway]) -> None:
    """So does the metadata, by its values; an error of the server closes the connection, as servers do."""
    answer = pack({"actions": np.ones((2, 3), np.float32), "extra": [1, "a", None]})
    with serving(says(answer, "Traceback\nValueError: no gripper")) as endpoint:
        door = gateway(f"--site=gpu={endpoint}")
        with connect(f"ws://127.0.0.1:{door.port}", compression=None) as client:
            assert unpack(client.recv()) == {"name": "test"}
            client.send(pack({"state": np.zeros(3)}))
            assert client.recv() == answer
            client.send(pack({"state": np.zeros(3)}))
            said = "gpu: CloudBroken: the policy server failed: ValueError: no gripper"
            assert client.recv() == f"no policy server has answered: {said}"
            with pytest.raises(ConnectionClosed):
                client.recv()


@pytest.mark.parametrize("scheme", ["ws", "groot"])
def test_a_server_of_the_other_protocol_answers(
    scheme: str,
    policy_server: Start,
    groot: Callable[..., GrootServer],
    gateway: Callable[..., Gateway],
) -> None:
    """Two functions turn observations and actions around."""
    other = policy_server() if scheme == "groot" else groot()
    name = "openpi" if scheme == "groot" else "groot"
    door = gateway(f"--site=other={other.endpoint}", f"--convert=other=onboard:{name}", scheme=scheme)
    if scheme == "groot":
        with PolicyClient("127.0.0.1", door.port) as client:
            until(lambda: _answers(lambda: client.get_action({"state": np.ones(3, np.float32)})))
            action, info = client.get_action({"state": np.ones(3, np.float32)})
        assert (action["action"].tolist(), info) == ([2.0, 2.0, 2.0], {"by": "gpu"})
    else:
        with WebsocketClientPolicy("127.0.0.1", door.port) as policy:
            until(lambda: _answers(lambda: policy.infer({"state": np.ones(3, np.float32)})))
            answer = policy.infer({"state": np.ones(3, np.float32)})
        assert (answer["actions"].tolist(), answer["by"]) == ([2.0, 2.0, 2.0], "groot")


def _answers(ask: Callable[[], Any]) -> bool:
    """Whether there is an answer: the servers of these tests take a while to start."""
    try:
        ask()
    except CloudBroken:
        return False
    return True


@pytest.mark.timeout(CHAOS_S + 120)
def test_clients_get_their_own_answers(policy_server: Start, gateway: Callable[..., Gateway]) -> None:
    """While servers are killed, frozen and late, each answer to four clients is that of its question."""
    servers = [policy_server(), policy_server()]
    sites = [f"--site={name}={one.endpoint}" for name, one in zip(("gpu", "near"), servers, strict=True)]
    door = gateway(*sites, "--onboard=onboard:act", "--deadline=0.3")
    right, over = [0] * 4, threading.Event()

    def robot(number: int) -> None:
        draw = random.Random(number)
        with connect(f"ws://127.0.0.1:{door.port}", compression=None) as client:
            client.recv()
            for step in itertools.count():
                if over.is_set():
                    return
                state = np.array([number, step], np.float32)
                late_s = 0.5 if draw.random() < 0.02 else 0.002
                client.send(pack({"state": state, "delay_s": late_s}))
                assert unpack(client.recv(timeout=WAIT_S))["actions"].tolist() == [2.0 * number, 2.0 * step]
                right[number] += 1

    threads = [threading.Thread(target=robot, args=(number,)) for number in range(4)]
    for one in threads:
        one.start()
    draw, until_s = random.Random(1), time.monotonic() + CHAOS_S
    while time.monotonic() < until_s:
        server = draw.choice(servers)
        time.sleep(draw.uniform(0.2, 1.0))
        if draw.random() < 0.5:
            server.kill()
            time.sleep(draw.uniform(0.2, 1.0))
            server.start()
        else:
            server.signal(signal.SIGSTOP)
            time.sleep(draw.uniform(0.2, 1.0))
            server.signal(signal.SIGCONT)
    before = list(right)
    time.sleep(1.0)
    over.set()
    for one in threads:
        one.join(WAIT_S)
    print(f"{sum(right)} right answers")
    assert not any(one.is_alive() for one in threads)
    assert all(later > earlier > 0 for earlier, later in zip(before, right, strict=True))


def test_the_drop_in_client_needs_one_changed_import(policy_server: Start) -> None:
    """A killed server costs no answer with an onboard policy; without one, the error names the server."""
    server = policy_server()
    port = int(server.endpoint.rpartition(":")[2])
    double: Any = lambda one: {"actions": one["state"] * 2, "by": "onboard"}  # noqa: E731
    with WebsocketClientPolicy("127.0.0.1", port, onboard=double, deadline_s=0.5) as policy:
        assert policy.get_server_metadata() == {}
        until(lambda: policy.infer({"state": np.ones(3)})["by"] == "gpu")  # the server has started
        used: set[str] = set()
        last: Any = lambda: policy._sites.offload.last  # noqa: E731
        for number in range(200):
            if number == 100:
                server.kill()
            answer = policy.infer({"state": np.full(3, number, np.float32)})
            assert answer["actions"].tolist() == [2.0 * number] * 3
            used.add(answer["by"])
            if answer["by"] == "onboard" and number < 100:  # it is quicker, and no probe of it is played
                runs = [one for one in last().executions if one.site == "server"]
                assert all(one.seconds > LATE_S for one in runs), last()
            policy.reset()
        assert used == {"gpu", "onboard"}
    server.start()
    with WebsocketClientPolicy("127.0.0.1", port) as policy:
        assert policy.infer({"state": np.ones(3)})["by"] == "gpu"
        server.kill()
        with pytest.raises(CloudBroken, match=r"^no policy server has answered: "):
            policy.infer({"state": np.ones(3)})


def test_a_client_with_a_stream_answers_at_once(policy_server: Start) -> None:
    """Each `infer` returns the action of its step, from a queue that is kept filled."""
    server = policy_server()
    port = int(server.endpoint.rpartition(":")[2])
    onboard: Any = lambda one: {"actions": one["state"]}  # noqa: E731
    with WebsocketClientPolicy(
        "127.0.0.1", port, onboard=onboard, stream=True, hz=50.0, horizon=25
    ) as policy:
        for _ in range(100):
            began_s = time.perf_counter()
            answer = policy.infer({"state": np.ones((25, 4), np.float32), "delay_s": 0.1})
            assert answer["actions"].shape == (1, 4)
            time.sleep(max(0.0, 0.02 - (time.perf_counter() - began_s)))
        assert answer["offboard"]["site"] == "server"
        assert answer["actions"].tolist() == [[2.0] * 4]
        policy.reset()
    with pytest.raises(ConfigError, match=r"stream=True needs hz= and horizon="):
        WebsocketClientPolicy("127.0.0.1", port, stream=True)


def test_a_token_is_sent_as_servers_expect() -> None:
    """`Api-Key` comes before it, unless it names its scheme; it is in no message of an error."""
    seen: list[str | None] = []

    def talk(connection: Any) -> None:
        seen.append(connection.request.headers.get("Authorization"))
        for _ in connection:
            connection.send(pack({"by": "gpu"}))

    with serving(talk) as endpoint:
        port = int(endpoint.rpartition(":")[2])
        for token in ("a-secret", "Bearer b-secret"):
            with WebsocketClientPolicy("127.0.0.1", port, api_key=token) as policy:
                assert policy.infer({"state": 1}) == {"by": "gpu"}
    assert seen == ["Api-Key a-secret", "Bearer b-secret"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "--site"),
        (("--site=gpu",), "--site: 'gpu' is not NAME=ws://HOST:PORT"),
        (
            ("--site=gpu=groot://127.0.0.1:1",),
            "--site gpu: 'groot://127.0.0.1:1' is not ws:// or wss://, as --listen",
        ),
        (("--site=gpu=ws://10.0.0.1:1",), "is not encrypted"),
        (
            ("--site=gpu=ws://127.0.0.1:1", "--listen=ws://0.0.0.0:8000"),
            "ws://0.0.0.0:8000",
        ),
        (("--site=gpu=ws://127.0.0.1:1", "--convert=far=json:loads"), "--convert: 'far' is no --site"),
        (
            ("--site=gpu=ws://127.0.0.1:1", "--convert=gpu=json:loads"),
            "--convert gpu: <function loads at",
        ),
        (
            ("--site=gpu=ws://127.0.0.1:1", "--onboard=nothing:act"),
            "'nothing:act': No module",
        ),
    ],
)
def test_a_wrong_flag_is_one_line(flags: tuple[str, ...], said: str) -> None:
    """With the exit code of a usage error."""
    done = subprocess.run(
        [sys.executable, "-m", "offboard.robot_client", "gateway", *flags],
        capture_output=True, text=True, check=False, timeout=WAIT_S,
    )  # fmt: skip
    assert done.returncode == USAGE_EXIT
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_policy_server_is_checked_step_by_step(policy_server: Start, tmp_path: Path) -> None:
    """Each step has its line; a dead server fails the second one, with a remedy."""
    server = policy_server()
    np.savez(tmp_path / "seen.npz", state=np.ones(3, np.float32), prompt="open the drawer")
    command = [sys.executable, "-m", "offboard.robot_client", "check", server.endpoint]

    def check(*flags: str) -> tuple[int, list[str]]:
        done = subprocess.run([*command, *flags], capture_output=True, text=True, check=False, timeout=WAIT_S)
        return done.returncode, done.stdout.splitlines()

    for _ in range(int(START_S)):  # until the server has started
        code, lines = check(f"--observation={tmp_path / 'seen.npz'}")
        if code == 0:
            break
        time.sleep(0.5)
    assert [line.split()[0] for line in lines] == ["ok"] * 4
    assert "plain; it wants no token; metadata: empty" in lines[2]
    assert "{actions float32[3], by 'gpu'" in lines[3]
    assert check()[1][3].split()[0] == "skip"
    server.kill()
    code, lines = check()
    assert (code, [line.split()[0] for line in lines]) == (1, ["ok", "FAIL", "skip", "skip"])
    assert "start the policy server" in lines[1]
