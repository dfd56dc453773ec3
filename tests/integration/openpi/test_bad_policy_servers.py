"""Policy servers that send garbage, errors or nothing: the robot answers, and the log says it once."""

import logging
import socket
import ssl
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from websockets.sync.server import ServerConnection

from offboard.common.errors import CloudBroken, CloudTimeout, OffloadError
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policy_servers import openpi
from offboard.robot_client.policy_servers.openpi import pack
from offboard.robot_client.policy_servers.protocol import ANSWER_BYTES_MAX
from offboard.robot_client.sites.runner import ONBOARD
from tests.integration.openpi.bad_servers import METADATA, Talk, says, serving, stays
from tests.integration.openpi.robot import (
    START_S,
    act,
    observation,
    of_gpu,
    right,
    undeclared,
    until,
    why_absent,
)

pytestmark = pytest.mark.integration

TRACEBACK = 'Traceback (most recent call last):\n  File "policy.py", line 1\nValueError: no gripper'
SHORT_ARRAY = pack({b"__ndarray__": True, b"data": b"1234", b"dtype": "<f4", b"shape": [2]})


@pytest.mark.parametrize(
    ("talk", "failure", "text"),
    [
        (says(b"\xc1"), CloudBroken, "answer: not msgpack"),
        (says(b""), CloudBroken, "answer: not msgpack"),
        (says(SHORT_ARRAY), CloudBroken, "answer: an array of shape"),
        (says(TRACEBACK), CloudBroken, "the policy server failed: ValueError: no gripper"),
        (
            says(pack({"type": "error", "message": "no model"})),
            CloudBroken,
            "the policy server failed: no model",
        ),
        (says(b"\x00" * (ANSWER_BYTES_MAX + 1)), CloudBroken, "the connection was lost"),
        (lambda connection: connection.recv() and None, CloudBroken, "the connection was lost"),
        (stays, CloudTimeout, "no answer within the budget"),
    ],
)
def test_a_bad_answer_costs_only_itself(talk: Talk, failure: type[OffloadError], text: str) -> None:
    """The call has the answer of the robot, and its record says what the server did."""
    with serving(talk) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        action = offload(
            act, observation(2.0), where="gpu", timeout_s=0.3 if failure is CloudTimeout else START_S
        )
        assert right(action, 2.0)
        assert action["by"] == ONBOARD
        assert type(of_gpu(offload).failure) is failure
        assert text in str(of_gpu(offload).failure)


@pytest.mark.parametrize(
    ("greeting", "reason"),
    [
        ("Robot policy not available", "the server says: Robot policy not available"),
        (b"\xc1", "not msgpack"),
        (pack([1]), "the first message of the server is no metadata"),
        (None, "it sends no metadata"),
    ],
)
def test_a_server_without_metadata_gets_no_task(
    greeting: bytes | str | None, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reason of the site says what came instead."""
    monkeypatch.setattr(openpi, "OPEN_S", 0.2)
    with serving(stays, greeting) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        until(lambda: reason in why_absent(offload))
        assert offload(act, observation(), where="gpu")["by"] == ONBOARD


def test_what_is_no_websocket_server_gets_no_task(
    cloud: Callable[[Callable[[socket.socket], None]], int],
) -> None:
    """A port where something else answers is no error of the call."""
    port = cloud(lambda connection: connection.sendall(b"SSH-2.0-x\r\n") or connection.close())
    with Offloader.connect(sites={"gpu": f"ws://127.0.0.1:{port}"}) as offload:
        until(lambda: "not connected to ws://" in why_absent(offload))
        assert offload(act, observation(), where="gpu")["by"] == ONBOARD


def test_a_task_that_is_not_declared_stays_onboard() -> None:
    """Waiting does not help, so `wait_for_sites` returns at once and says what to declare."""
    with serving(stays) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        absent = offload.wait_for_sites(undeclared, START_S)
        assert absent == {
            "gpu": "a policy server takes only tasks with policy_server=True; openpi_undeclared is none"
        }
        assert offload(undeclared, 5) == 5


def test_garbage_is_logged_once_and_then_avoided(caplog: pytest.LogCaptureFixture) -> None:
    """Of many bad answers one is logged; after three in a row the site is left alone for a while."""
    with serving(says(b"\xc1")) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        with caplog.at_level(logging.WARNING):
            for _ in range(3):
                offload(act, observation(), where="gpu")
        lines = [one for one in caplog.messages if "(others within 10 s are not logged)" in one]
        assert len(lines) == 1
        assert "answer: not msgpack" in lines[0]
        assert "the last 3 calls" in why_absent(offload)


def test_a_message_that_nobody_asked_for_ends_the_connection() -> None:
    """Otherwise it would be taken for the answer to the next observation."""
    connections: list[ServerConnection] = []

    def talk(connection: ServerConnection) -> None:
        connections.append(connection)
        if len(connections) == 1:
            connection.send(pack({"actions": "of nobody"}))
        says(pack({"by": "gpu"}))(connection)

    with serving(talk) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        until(lambda: len(connections) == 2)
        assert not offload.wait_for_sites(act, START_S)
        assert offload(act, observation(), where="gpu") == {"by": "gpu"}


def test_encryption_needs_a_certificate_that_the_robot_trusts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With wss:// the server must prove who it is; SSL_CERT_FILE names an authority of your own."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    command += ["-days", "1", "-keyout", str(key), "-out", str(certificate), "-subj", "/CN=test"]
    subprocess.run([*command, "-addext", "subjectAltName=IP:127.0.0.1"], check=True, capture_output=True)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)
    with serving(says(pack({"by": "gpu"})), METADATA, tls) as endpoint:
        assert endpoint.startswith("wss://")
        with Offloader.connect(sites={"gpu": endpoint}) as offload:
            until(lambda: "certificate verify failed" in why_absent(offload))
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with Offloader.connect(sites={"gpu": endpoint}) as offload:
            assert not offload.wait_for_sites(act, START_S)
            assert offload(act, observation(), where="gpu") == {"by": "gpu"}
