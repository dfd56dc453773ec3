"""How connections of the relay end: half-closed, abandoned or reset, and who gets their slot."""

import asyncio
import contextlib
import socket
import struct
import threading
import time
from typing import Any

import pytest

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.relay import Relay, RelaySettings
from offboard.robot_client.cloud.connection import BROKEN_HANDSHAKE
from offboard.robot_client.offloader import Offloader
from tests import probes
from tests.curves import Served, until
from tests.relays import WAIT_S, echo, is_reset, receive, round_trip_s, silent, wait_until

pytestmark = pytest.mark.integration

BARE = ("--delay-ms", "0", "--bandwidth-mbps", "0")
RST_AT_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: on, 0 seconds


def connections(relay: Any) -> int:
    return int(relay.ask("GET", "/link")[1]["connections"])


def leave(client: socket.socket) -> None:
    """Close by RST."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RST_AT_CLOSE)
    client.close()


def test_a_client_that_closes_its_half_gets_the_answer(cloud: Any, wan: Any) -> None:
    """The cloud receives the end and then sends 3 MB, which arrive complete through small buffers."""
    data = b"".join(n.to_bytes(4, "big") for n in range(750_000))

    def talk(connection: socket.socket) -> None:
        asked = receive(connection, 1 << 30)
        time.sleep(0.05)
        connection.sendall(asked)

    relay = wan(cloud(talk), "--delay-ms", "5", "--bandwidth-mbps", "0", "--buffer-bytes", "65536")
    with relay.connect() as client:
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)
        assert receive(client, len(data) + 1) == data
    wait_until(lambda: connections(relay) == 0)


def test_a_cloud_that_closes_its_half_still_receives(cloud: Any, wan: Any) -> None:
    """The client gets the bytes and the end of the cloud, and its own bytes still arrive; then both close."""
    heard: list[bytes] = []

    def talk(connection: socket.socket) -> None:
        connection.sendall(b"bye")
        connection.shutdown(socket.SHUT_WR)
        heard.append(receive(connection, 1 << 30))

    relay = wan(cloud(talk), "--delay-ms", "5")
    with relay.connect() as client:
        assert receive(client, 4) == b"bye"
        client.sendall(b"x" * 100_000)
    wait_until(lambda: heard == [b"x" * 100_000])
    wait_until(lambda: connections(relay) == 0)


def test_a_client_that_resets_ends_the_connection(cloud: Any, wan: Any) -> None:
    """The connection to the cloud ends, even if all buffers to the client are full."""
    ended = threading.Event()

    def talk(connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection.sendall(bytes(65536))
        ended.set()

    relay = wan(cloud(talk), *BARE, "--buffer-bytes", "65536")
    client = relay.connect()
    assert receive(client, 1) == b"\0"
    time.sleep(0.1)  # all buffers are full
    leave(client)
    assert ended.wait(WAIT_S)
    wait_until(lambda: connections(relay) == 0)


@pytest.mark.parametrize("hang", ["hang", "up-hang", "down-hang"])
@pytest.mark.parametrize("says", [b"", b"ping"])
def test_a_client_that_leaves_in_a_hang_frees_its_slot(cloud: Any, wan: Any, hang: str, says: bytes) -> None:
    """A client that closes ends its connection during the hang, whether or not bytes were lost."""
    relay = wan(cloud(echo), *BARE, "--connections-max", "1", f"--{hang}")
    for _ in range(3):
        with relay.connect() as client:
            client.sendall(says)
            assert silent(client)
        wait_until(lambda: connections(relay) == 0)
    assert relay.ask("GET", "/link")[1]["refused"] == 0
    relay.change(hang=False)
    with relay.connect() as client:
        round_trip_s(client)


def test_a_new_hang_drops_an_end_under_way(cloud: Any, wan: Any) -> None:
    """The end of a client that has already left is lost in the hang, and its connection is closed."""
    relay = wan(cloud(echo), "--delay-ms", "30000", "--connections-max", "1")
    relay.connect().close()
    wait_until(lambda: relay.ask("GET", "/link")[1]["accepted"] == 1)
    assert connections(relay) == 1
    relay.change(hang=True)
    wait_until(lambda: connections(relay) == 0)


def test_a_cloud_that_closes_in_a_hang_is_silent(cloud: Any, wan: Any) -> None:
    """With a hang from cloud to robot, the client gets neither answer nor end, and later a reset."""
    relay = wan(cloud(lambda connection: connection.sendall(b"bye")), *BARE, "--down-hang")
    with relay.connect() as client:
        assert silent(client)
        with contextlib.suppress(OSError):
            client.sendall(b"ping")
        assert silent(client)
        relay.change(hang=False)
        assert is_reset(client)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_clients_that_leave_in_an_outage_make_room(cloud: Any, wan: Any, direction: str) -> None:
    """Their connections end when slots are needed; bytes of the other clients arrive after the outage."""
    relay = wan(cloud(echo), *BARE, "--connections-max", "2")
    with relay.connect() as stays:
        round_trip_s(stays)
        relay.change(**{direction: {"outage": True}})
        stays.sendall(b"more")
        for number in range(5):
            with relay.connect() as client:
                client.sendall(b"ping")
                wait_until(lambda n=number: relay.ask("GET", "/link")[1]["accepted"] == n + 2)
        with relay.connect() as last:
            last.sendall(b"last")
            with relay.connect() as late:
                assert late.recv(1) == b""  # both slots are in use
            counts = relay.ask("GET", "/link")[1]
            assert (counts["connections"], counts["refused"]) == (2, 1)
            relay.change(outage=False)
            assert receive(stays, 4) == b"more"
            assert receive(last, 4) == b"last"


def test_a_client_that_left_makes_room_while_the_cloud_stays(cloud: Any, wan: Any) -> None:
    """A cloud that keeps its connections when their clients leave does not use up the slots."""
    done = threading.Event()
    ends: list[bytes] = []

    def talk(connection: socket.socket) -> None:
        ends.append(connection.recv(1))
        done.wait(WAIT_S)

    relay = wan(cloud(talk), *BARE, "--connections-max", "1")
    for number in range(1, 4):
        relay.connect().close()
        wait_until(lambda n=number: ends == [b""] * n)
    done.set()
    assert relay.ask("GET", "/link")[1]["refused"] == 0


def test_a_client_with_bytes_under_way_keeps_its_slot(cloud: Any, wan: Any) -> None:
    """A client that has left keeps its slot until its bytes are delivered; a new client is closed."""
    got: list[bytes] = []
    relay = wan(
        cloud(lambda connection: got.append(receive(connection, 1 << 30))),
        *("--delay-ms", "2000", "--connections-max", "1"),
    )
    with relay.connect() as client:
        client.sendall(b"x" * 10_000)
    with relay.connect() as late:
        assert late.recv(1) == b""
    wait_until(lambda: got == [b"x" * 10_000])


async def resets(host: str, port: int) -> bool:
    """Whether a connection ends by RST, maybe even before it is open."""
    try:
        reader, writer = await asyncio.open_connection(host, port)
        with contextlib.closing(writer):
            return await asyncio.wait_for(reader.read(1), WAIT_S) is None
    except ConnectionResetError:
        return True


def test_a_reset_of_a_new_connection_is_not_lost() -> None:
    """A reset works before the socket is set up, and while the connection to the cloud is opened."""

    async def play() -> list[bool]:
        found = []
        listening = socket.create_server(("127.0.0.1", 0))
        target = listening.getsockname()[:2]
        relay = Relay(target, Link(), RelaySettings(seed=0, connections_max=8, buffer_bytes=1 << 20))

        def accept() -> asyncio.BaseProtocol:
            protocol = relay.accept()
            assert relay.reset() == 1
            return protocol

        server = await asyncio.get_running_loop().create_server(accept, "127.0.0.1", 0)
        for _ in range(5):
            found.append(await resets(*server.sockets[0].getsockname()))
            await relay.ended(WAIT_S)
        assert not relay.connections
        server.close()
        listening.close()
        return found

    assert asyncio.run(play()) == [True] * 5


@pytest.mark.parametrize("after_ms", ["1e-6", "0.05", "1"])
def test_a_reset_that_is_due_at_once_is_not_lost(cloud: Any, wan: Any, after_ms: str) -> None:
    """Every connection is reset, however soon after the accept the reset is due."""
    relay = wan(cloud(echo), *BARE, "--reset-after-ms", after_ms)
    for _ in range(20):
        with contextlib.suppress(ConnectionResetError), relay.connect() as client:
            assert is_reset(client)
    wait_until(lambda: connections(relay) == 0)


def test_a_server_that_was_killed_behind_the_relay_is_not_blamed_on_keys(
    wan: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Without keys the reason is the broken connection. When a server is back, the log says so once."""
    served = Served()
    relay = wan(served.port, *BARE)
    try:
        with Offloader.connect(f"tcp://127.0.0.1:{relay.port}", policy="cloud") as offload:
            assert offload.wait_for_sites(probes.echo, WAIT_S) == {}
            served.process.kill()
            until(lambda: BROKEN_HANDSHAKE in str(offload.wait_for_sites(probes.echo, 0.0)))
            assert "key" not in str(offload.wait_for_sites(probes.echo, 0.0))
            served.close()
            served = Served("--listen", f"tcp://127.0.0.1:{served.port}")
            assert offload.wait_for_sites(probes.echo, WAIT_S) == {}
    finally:
        served.close()
    said = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
    assert [text.partition("; remedy: ")[0].partition(" again ")[0] for text in said] == [
        f"cloud: connection to tcp://127.0.0.1:{relay.port} lost",
        f"cloud: connected to tcp://127.0.0.1:{relay.port}",
    ]
