"""Attacks on a server by a bad robot or a stranger; docs/security.md has a row for each."""

import contextlib
import random
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
import zmq

from benchmarks import attacks
from benchmarks.attack_connections import IDLE, PLAIN_GREETING, READY, curve_greeting
from benchmarks.attack_messages import bombs, mutate, request, valid_messages
from benchmarks.attack_target import Target, dealer
from benchmarks.attackers import ATTACKS
from benchmarks.keyring import Keys
from offboard.cloud_server.rate_limit import CUT_OFF_S
from offboard.cloud_server.robot_socket import HANDSHAKE_S
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Point, Pose, plan_path
from offboard.common.security.bounded_http import CONNECTIONS_MAX, REQUEST_S
from offboard.common.security.keys import robot_keys
from offboard.common.wire import messages as wire
from offboard.robot_client.offloader import Offloader
from tests.curves import WAIT_S, Dealer, Served, until
from tests.probes import echo

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

MIB = 1 << 20
MESSAGE_MIB, BLOB_MIB = 16, 32
SIZES = ("--message-mib", f"{MESSAGE_MIB}", "--blob-mib", f"{BLOB_MIB}")
GARBAGE = 100_000  # messages
MUTATED = 20_000
CLAIMED = 2**32  # bytes
PING = 777_777
UNREAD_MIB = 400  # two messages, and what loopback transfers in a tenth of a second


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return Keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def attacker(keys: Keys) -> Path:
    return keys.add("attacker")


@pytest.fixture(scope="module")
def good(keys: Keys) -> Path:
    return keys.add("good")


@pytest.fixture(scope="module")
def served(keys: Keys, attacker: Path, good: Path) -> Iterator[Served]:  # noqa: ARG001 - the keys must exist before
    """One server for all attacks: what one attack breaks, the next one finds."""
    unbounded = ("--robot-mib-s", "65536")  # so that no attack is cut off for its rate
    served = Served(
        "--keys",
        str(keys.server),
        "--tasks",
        "tests.probes,offboard.common.planning.planner",
        *SIZES,
        *unbounded,
    )
    yield served
    served.close()
    forged = [line for line in served.lines if "mallory" in line and "\\n" not in line]
    assert not forged, forged


@pytest.fixture
def target(served: Served, attacker: Path) -> Target:
    return Target(served.endpoint, int(served.http.rpartition(":")[2]), attacker)


def memory(served: Served) -> int:
    return attacks.memory(served.process.pid, "VmRSS")


def dropped(served: Served) -> float:
    text = httpx.get(f"{served.http}/metrics").text
    return sum(
        float(line.split()[-1])
        for line in text.splitlines()
        if line.startswith("offboard_server_dropped_messages_total")
    )


def is_served(served: Served, keys: Path | None) -> None:
    """The cloud answers a task of a good robot."""
    with Offloader.connect(served.endpoint, policy="cloud", keys=keys) as offload:
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        assert offload(echo, "still there") == "still there"
        assert offload.last is not None
        assert offload.last.used == "cloud", offload.last.executions


def until_pong(client: "zmq.Socket[bytes]") -> list[wire.Message]:
    """All answers of the server until it answers a ping. It may ignore pings above the rate limit."""
    answers: list[wire.Message] = []
    until_s = time.monotonic() + WAIT_S
    while not any(isinstance(one, wire.Pong) and one.id == PING for one in answers):
        assert time.monotonic() < until_s, "no answer to the ping"
        client.send_multipart(wire.pack(wire.Ping(PING)))
        while client.poll(200):
            answers.append(wire.unpack(client.recv_multipart()))
    return answers


def test_garbage_is_dropped_and_counted(served: Served, target: Target, good: Path) -> None:
    """100,000 messages of random bytes cost no memory, and the next robot is served."""
    before, at_first = dropped(served), memory(served)
    attack = ATTACKS["garbage"](target)
    with contextlib.closing(attack):
        for _ in range(GARBAGE):
            next(attack)
        until(lambda: dropped(served) - before > GARBAGE / 2)  # messages beyond a full socket are not sent
    is_served(served, good)
    assert memory(served) - at_first < 2 * MESSAGE_MIB * MIB


def test_changed_messages_do_no_harm(served: Served, target: Target, good: Path) -> None:
    """The server answers or drops good messages with changed bits, bytes, lengths or frames."""
    rng, messages = random.Random(5), valid_messages()
    with dealer(target) as client:
        client.sndtimeo = int(WAIT_S * 1000)
        answers = []
        for _ in range(MUTATED):
            client.send_multipart(mutate(rng.choice(messages), rng))
            while client.poll(0):
                answers.append(wire.unpack(client.recv_multipart()))
        answers += until_pong(client)
    statuses = Counter(one.status for one in answers if isinstance(one, wire.Reply))
    assert statuses["ok"] > 0
    assert statuses["failed"] > 0
    is_served(served, good)


@pytest.mark.parametrize("name", bombs())
def test_bombs_cost_no_memory(served: Served, target: Target, good: Path, name: str) -> None:
    """Small messages that claim to be large, or that contain code, are refused or dropped."""
    at_first = memory(served)
    with dealer(target) as client:
        client.send_multipart(bombs()[name])
        answers = until_pong(client)
    replies = [one for one in answers if isinstance(one, wire.Reply)]
    assert all(one.status in ("failed", "unknown_task", "need_blob") for one in replies), replies
    assert served.process.poll() is None
    assert memory(served) - at_first < MESSAGE_MIB * MIB
    is_served(served, good)


@pytest.mark.parametrize("encrypted", [False, True], ids=["plain", "curve"])
def test_a_claim_of_4_gb_is_not_believed(served: Served, good: Path, encrypted: bool) -> None:
    """A frame that claims 4 GB costs no memory, and its connection is closed."""
    at_first = memory(served)
    greeting = curve_greeting() if encrypted else PLAIN_GREETING + READY
    with socket.create_connection(("127.0.0.1", served.port), WAIT_S) as client:
        client.sendall(greeting + b"\x06" + CLAIMED.to_bytes(8, "big"))
        with contextlib.suppress(ConnectionResetError):
            while client.recv(65536):
                pass
    assert memory(served) - at_first < MESSAGE_MIB * MIB
    is_served(served, good)


def test_a_claim_of_4_gb_is_not_believed_without_keys() -> None:
    """Without keys anyone can finish the handshake; a frame that claims 4 GB still costs no memory."""
    served = Served(*SIZES)
    try:
        at_first = memory(served)
        with socket.create_connection(("127.0.0.1", served.port), WAIT_S) as client:
            client.sendall(PLAIN_GREETING + READY)
            answered = b""
            while b"READY" not in answered:
                answered += client.recv(65536)
            client.sendall(b"\x02" + CLAIMED.to_bytes(8, "big"))
            with contextlib.suppress(ConnectionResetError):
                while client.recv(65536):
                    pass
        assert memory(served) - at_first < MESSAGE_MIB * MIB
    finally:
        served.close()


def test_a_message_without_end_is_cut_off() -> None:
    """The connection of an endless message is closed before it takes all memory."""
    served = Served(*SIZES)
    try:
        at_first, most = memory(served), 0
        attack = ATTACKS["endless"](Target(served.endpoint, 0, None))
        with contextlib.closing(attack):
            until_s = time.monotonic() + WAIT_S
            while served.logged("more than could be read") < 3 and time.monotonic() < until_s:
                next(attack)
                most = max(most, memory(served) - at_first)
        print(f"{most / MIB:.0f} MiB")
        assert served.logged("more than could be read") == 3
        assert most < UNREAD_MIB * MIB
        is_served(served, None)
    finally:
        served.close()


def test_unread_replies_are_limited(served: Served, target: Target, good: Path) -> None:
    """If a robot asks for large results and reads none, the bytes that wait for it are limited."""
    at_first = memory(served)
    body = wire.encode([MESSAGE_MIB * MIB // 2]).frames
    with dealer(target) as client:
        client.rcvhwm = 1
        for _ in range(60):
            client.send_multipart(request(body, "zeros"))
            time.sleep(0.02)
        assert memory(served) - at_first < 6 * MESSAGE_MIB * MIB
        assert dropped(served) > 0
    is_served(served, good)


def test_bytes_per_second_are_limited(keys: Keys, attacker: Path, good: Path) -> None:
    """Above --robot-mib-s requests are answered `busy`; another robot is served."""
    served = Served("--keys", str(keys.server), *SIZES, "--robot-mib-s", "1")
    try:
        with dealer(Target(served.endpoint, 0, attacker)) as client:
            body = wire.encode([bytes(60_000)]).frames
            statuses = []
            for _ in range(350):  # 64 KiB each; the first 16 MiB are free
                client.send_multipart(request(body, "echo"))
                assert client.poll(int(WAIT_S * 1000))
                reply = wire.unpack(client.recv_multipart())
                assert isinstance(reply, wire.Reply)
                statuses.append(reply.status)
            assert statuses[:250] == ["ok"] * 250
            assert statuses.count("busy") > 50
            is_served(served, good)
    finally:
        served.close()


def test_a_flood_is_cut_off(keys: Keys, attacker: Path, good: Path) -> None:
    """A robot that keeps flooding is disconnected and shut out for a while; other robots are served."""
    served = Served("--keys", str(keys.server), *SIZES)
    try:
        with contextlib.closing(ATTACKS["flood"](Target(served.endpoint, 0, attacker))) as attack:
            until_s = time.monotonic() + WAIT_S
            while not served.logged("cut off robot attacker") and time.monotonic() < until_s:
                next(attack)
        assert served.logged("cut off robot attacker") == 1
        assert not is_let_in(served, attacker)
        is_served(served, good)
        until(lambda: is_let_in(served, attacker), CUT_OFF_S + WAIT_S)
    finally:
        served.close()


def is_let_in(served: Served, keys: Path) -> bool:
    own = robot_keys(keys, "cloud")
    with Dealer(served.port, own.own.public, own.own.secret, own.server) as dealer:
        return dealer.handshake == zmq.EVENT_HANDSHAKE_SUCCEEDED


def test_slow_handshakes_end(served: Served, good: Path) -> None:
    """200 connections that send a byte now and then are closed after HANDSHAKE_S; robots are served."""
    clients = [socket.create_connection(("127.0.0.1", served.port), WAIT_S) for _ in range(200)]
    began = time.monotonic()
    text = iter(curve_greeting())
    try:
        while clients and time.monotonic() - began < 2 * HANDSHAKE_S:
            said = bytes([next(text, 0)])
            for client in list(clients):
                try:
                    client.sendall(said)
                    client.settimeout(0.001)
                    with contextlib.suppress(TimeoutError):
                        while client.recv(4096):
                            pass
                        raise ConnectionResetError
                except OSError:
                    client.close()
                    clients.remove(client)
            time.sleep(0.3)
            is_served(served, good)
    finally:
        for client in clients:
            client.close()
    assert not clients


def test_slow_http_connections_are_closed(served: Served) -> None:
    """/health is answered during more half-finished requests than the server keeps; those are closed."""
    address = ("127.0.0.1", int(served.http.rpartition(":")[2]))
    clients = [socket.create_connection(address, WAIT_S) for _ in range(CONNECTIONS_MAX + 50)]
    began = time.monotonic()
    try:
        for client in clients:
            with contextlib.suppress(OSError):
                client.sendall(b"GET /health HTTP/1.1\r\nX: ")
        assert httpx.get(f"{served.http}/health").status_code == 200
        while time.monotonic() - began < REQUEST_S + 2:
            for client in clients:
                with contextlib.suppress(OSError):
                    client.sendall(b"x")
            time.sleep(0.5)
            assert httpx.get(f"{served.http}/health").status_code == 200
        for client in clients:
            with contextlib.suppress(ConnectionResetError):
                assert client.recv(1) == b""
    finally:
        for client in clients:
            client.close()


def test_five_thousand_robots_can_be_idle(keys: Keys, attacker: Path, good: Path) -> None:
    """The server raises its limit of open files, serves another robot, and takes the documented memory."""
    served = Served("--keys", str(keys.server), *SIZES, files=1024)
    try:
        at_first = memory(served)
        attack = ATTACKS["idle"](Target(served.endpoint, 0, attacker))
        with contextlib.closing(attack):
            for _ in range(IDLE):
                next(attack)
            files = Path(f"/proc/{served.process.pid}/fd")
            until(lambda: len(list(files.iterdir())) > IDLE, 60.0)
            is_served(served, good)
            print((memory(served) - at_first) / IDLE, "bytes each")
            assert memory(served) - at_first < IDLE * attacks.CONNECTION_BYTES
    finally:
        served.close()


def test_a_good_robot_is_served_during_all_attacks(served: Served, target: Target, good: Path) -> None:
    """During all attacks but the idle one, each with half a core, no plan of a good robot is lost."""
    command = [sys.executable, "-m", "benchmarks.attackers"]
    place = [target.endpoint, str(target.http_port), str(target.keys)]
    attackers = [
        subprocess.Popen([*command, name, *place], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for name in ATTACKS
        if name != "idle"
    ]
    try:
        grid = GridMap(np.zeros((40, 60), np.int8), 0.1)
        with Offloader.connect(served.endpoint, policy="cloud", keys=good, timeout_s=WAIT_S) as offload:
            assert offload.wait_for_sites(plan_path, 3 * WAIT_S) == {}
            for n in range(100):
                plan = offload(plan_path, grid, None, Pose(0.5, 0.5), Point(0.6 + n / 100, 0.6))
                assert plan.status == "NONE"
    finally:
        steps = [int(one.communicate(timeout=WAIT_S)[0]) for one in attackers]
    assert all(steps), dict(zip(ATTACKS, steps, strict=False))
    is_served(served, good)
