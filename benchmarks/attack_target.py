"""The server under attack, and the ZMQ sockets through which attackers send messages to it."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import zmq

from benchmarks.attack_messages import Frames
from offboard.common.security.keys import robot_keys
from offboard.robot_client.sites.runner import CLOUD

SEND_S = 0.05  # longest wait for the server to read


@dataclass(frozen=True, slots=True)
class Target:
    """A server, and the folder with the keys of a robot that it knows; None if the server has no keys."""

    endpoint: str
    http_port: int
    keys: Path | None

    @property
    def port(self) -> int:
        return int(self.endpoint.rpartition(":")[2])


@contextlib.contextmanager
def dealer(target: Target, keys: Path | None = None) -> Iterator["zmq.Socket[bytes]"]:
    """A socket that connects again whenever the server ends the connection."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as client:
        prepare(client, keys or target.keys)
        client.connect(target.endpoint)
        yield client


def prepare(client: "zmq.Socket[bytes]", keys: Path | None) -> None:
    """Set the timeouts and the keys of a socket."""
    client.linger = 0
    client.sndtimeo = int(SEND_S * 1000)
    if keys is not None:
        mine = robot_keys(keys, CLOUD)
        client.curve_publickey, client.curve_secretkey = mine.own.public, mine.own.secret
        client.curve_serverkey = mine.server


def say(client: "zmq.Socket[bytes]", frames: Frames) -> None:
    """Send a message, if the server accepts it, and drop all replies."""
    with contextlib.suppress(zmq.Again):
        client.send_multipart(frames)
    with contextlib.suppress(zmq.Again):
        while True:
            client.recv_multipart(zmq.DONTWAIT)
