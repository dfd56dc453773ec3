"""A server that sends as fast as it can `hello`, by turns with messages of another wire version.

`python -m tests.flooding_server` prints its port and begins with the first message of a robot.
"""

import time

import msgpack
import zmq

from offboard.common.tasks import kinds
from offboard.common.wire import messages as wire
from tests import probes

SECONDS = 60.0  # at most, even if nobody ends this process


def flood(of: "zmq.Socket[bytes]") -> None:
    robot, *_ = of.recv_multipart()
    hello = wire.Hello({kind.name: kind.source_hash for kind in kinds()}, "0", 2**20)
    foreign = msgpack.packb([wire.VERSION + 1, "hello", {}])
    answers = [[robot, foreign], [robot, *wire.pack(hello)]]
    end_s = time.monotonic() + SECONDS
    while time.monotonic() < end_s:
        for frames in answers:
            of.send_multipart(frames)


if __name__ == "__main__":
    assert probes.echo(1) == 1  # a task that the robot has too
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.linger = 0
        print(socket.bind_to_random_port("tcp://127.0.0.1"), flush=True)
        flood(socket)
