"""Which robots and servers talk to each other, by their keys (docs/security.md), with real processes."""

from pathlib import Path

import pytest
import zmq

from benchmarks.keyring import Keys
from offboard.common.security.keys import PRIVATE, make_keys, robot_keys
from offboard.robot_client.cloud.connection import NO_HANDSHAKE, ONE_WITH_KEYS, UNKNOWN_ROBOT
from offboard.robot_client.offloader import Offloader
from tests.curves import WAIT_S, Dealer, recorded, says_until_closed, until
from tests.integration.keys.servers import Robot, Serve, metric, run, stays_onboard, why_not
from tests.probes import echo, mark_once, nap

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]


def test_a_robot_that_is_known_is_served(keys: Keys, serve: Serve, robot: Robot) -> None:
    """With keys on both sides tasks run in the cloud, and no argument crosses the network in plain text."""
    folder = keys.add("arm")
    served = serve(keys)
    with recorded(served.port) as way:
        offload = robot(f"tcp://127.0.0.1:{way.port}", folder)
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        assert offload(echo, "a secret of ours") == "a secret of ours"
        assert offload.last is not None
        assert offload.last.used == "cloud"
        offload.close()
        assert b"CURVE" in way.said
        assert b"echo" not in way.said
        assert b"a secret of ours" not in way.said


def test_a_robot_without_keys_is_not_served(keys: Keys, serve: Serve, robot: Robot) -> None:
    """The handshake fails, the tasks of the robot stay onboard, and the server reads none of its bytes."""
    served = serve(keys)
    offload = robot(served.endpoint, None)
    until(lambda: ONE_WITH_KEYS in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "received_bytes_total") == 0


def test_a_robot_that_is_not_known_is_refused(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Both sides say why, and the server counts it. Once its key is added, the robot is served."""
    served = serve(keys)
    offload = robot(served.endpoint, keys.make("stranger"))
    until(lambda: UNKNOWN_ROBOT in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "refused_handshakes_total") > 0
    until(lambda: served.logged("refused a robot at 127.0.0.1"))
    keys.let_in("stranger")
    assert offload.wait_for_sites(echo, WAIT_S) == {}


def test_a_stolen_public_key_is_of_no_use(keys: Keys, serve: Serve) -> None:
    """With the public keys of robot and server but without the private key, the handshake fails."""
    known = robot_keys(keys.add("arm"), "cloud")
    served = serve(keys)
    _, own_secret = zmq.curve_keypair()
    with Dealer(served.port, known.own.public, own_secret, known.server) as thief:
        assert thief.handshake == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    with Dealer(served.port, known.own.public, known.own.secret, known.server) as owner:
        assert owner.handshake == zmq.EVENT_HANDSHAKE_SUCCEEDED


def test_a_replayed_request_does_not_run(keys: Keys, serve: Serve, robot: Robot, tmp_path: Path) -> None:
    """Recorded bytes of a robot are refused on a new connection and on its own, and the task ran once."""
    folder, mark = keys.add("arm"), tmp_path / "mark"
    served = serve(keys)
    with recorded(served.port) as way:
        offload = robot(f"tcp://127.0.0.1:{way.port}", folder)
        assert offload.wait_for_sites(mark_once, WAIT_S) == {}
        before = len(way.said)
        assert offload(mark_once, str(mark)) == served.process.pid
        request = way.said[before:]
        assert request
        answer = says_until_closed(served.port, way.said)  # it returns, so the server closed the connection
        assert b"READY" not in answer
        way.server.sendall(request)
        until(lambda: why_not(offload))
    assert mark.read_text().count("\n") == 1


def test_a_server_with_another_key_gets_no_task(keys: Keys, serve: Serve, robot: Robot) -> None:
    """A robot sends nothing readable to a server whose key is not the one that it knows."""
    folder = keys.add("arm")
    served = serve(keys)
    (folder / "server.key").unlink()
    make_keys(folder, "server")
    (folder / f"server{PRIVATE}").unlink()
    offload = robot(served.endpoint, folder)
    until(lambda: NO_HANDSHAKE in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "received_bytes_total") == 0


def test_a_plain_server_gets_no_task_from_a_robot_with_keys(keys: Keys, serve: Serve, robot: Robot) -> None:
    """A robot with keys never sends plain text."""
    served = serve(None)
    offload = robot(served.endpoint, keys.add("arm"))
    until(lambda: ONE_WITH_KEYS in why_not(offload))
    assert metric(served, "received_bytes_total") == 0


@pytest.mark.parametrize(
    "said",
    [
        b"GET / HTTP/1.1\r\nHost: here\r\n\r\n" + b" " * 64,
        # ZMTP 3.0: a greeting with the mechanism NULL, READY, and a message.
        b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48) + b"\x04\x06\x05READY" + b"\x00\x05hello",
    ],
    ids=["http", "null"],
)
def test_plain_text_is_not_read(keys: Keys, serve: Serve, said: bytes) -> None:
    """A server with keys closes the connection of a plain-text client, and reads no message of it."""
    served = serve(keys)
    answered = says_until_closed(served.port, said)
    assert b"READY" not in answered
    assert metric(served, "received_bytes_total") == 0


def test_each_site_has_its_own_server_key(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """NAME.key is the key of the server of --site NAME, and server.key that of all other servers."""
    (tmp_path / "elsewhere").mkdir()
    others = Keys(tmp_path / "elsewhere")
    folder = keys.add("arm")
    (folder / "edge.key").write_bytes((others.server / "server.key").read_bytes())
    (others.robots / "arm.key").write_bytes((folder / "robot.key").read_bytes())
    cloud, edge = serve(keys), serve(others)
    with Offloader.connect(cloud.endpoint, sites={"edge": edge.endpoint}, keys=str(folder)) as offload:
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        for site in ("cloud", "edge"):
            assert offload(nap, 0.0, where=site) == 0.0
            assert offload.last is not None
            assert offload.last.used == site


def test_the_robot_command_takes_keys(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """`loadgen call` takes its keys from ROBOT_KEYS as from --keys, and its tasks run in the cloud."""
    served = serve(keys)
    folder, answers = keys.add("arm"), tmp_path / "trace.jsonl"
    flags = [
        "call",
        "--task",
        "tests.probes:nap",
        "--sizes",
        "constant:0",
        "--policy",
        "cloud",
        "--tasks",
        "3",
    ]
    flags += ["--cloud", served.endpoint, "--trace", str(answers)]
    done = run("loadgen", *flags, ROBOT_KEYS=str(folder))
    assert done.returncode == 0, done.stderr
    assert answers.read_text().count('"used":"cloud"') == 3, answers.read_text()
