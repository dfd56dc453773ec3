"""A server, or somebody in its place, that sends a robot what is no message."""

import logging

import pytest

from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Ping, Pong
from offboard.robot_client.sites.cloud import LOG_PAUSE_S
from tests.integration.test_heartbeats import Peer, met

pytestmark = pytest.mark.integration

HEARTBEAT_S = 0.1
ROUNDS = 300


def say_junk(peer: Peer) -> int:
    """Send bytes of the right version that are no message; return how many."""
    (head,) = wire.pack(Pong(0))
    whole = bytes(head)
    junk = [[whole[:-1]], [whole, b"more"], [whole[:1]], [whole[:1] + b"\xc1" * 8]]
    for frames in junk:
        peer._socket.send_multipart([peer._client, *frames])
    return len(junk)


def test_junk_gives_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """Within LOG_PAUSE_S at most one bad message is logged; the robot still sends heartbeats."""
    with caplog.at_level(logging.WARNING), met(HEARTBEAT_S) as (runner, peer):
        sent = sum(say_junk(peer) for _ in range(ROUNDS))
        for _ in range(3):
            ping = peer.hear()
            assert isinstance(ping, Ping)
            peer.say(Pong(ping.id))
        assert runner.condition().round_trip_s is not None
    dropped = [one.getMessage() for one in caplog.records if "message dropped" in one.getMessage()]
    assert len(dropped) == 1, f"{sent} sent"
    assert f"(others within {LOG_PAUSE_S:g} s are not logged)" in dropped[0]
