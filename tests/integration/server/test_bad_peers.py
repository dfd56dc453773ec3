"""Peers that send garbage or too much, do not read, or leave."""

import os
import random
from pathlib import Path

import numpy as np
import pytest

from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Blob, Cancel, Hello, Ping, Pong, Reply, Request
from tests.integration.server.peers import Join, Peer, Serve, until

pytestmark = pytest.mark.integration


def test_random_and_mutated_frames_do_no_harm(serve: Serve, join: Join) -> None:
    """During 2,000 garbage messages, all requests of a good robot are answered and memory does not grow."""
    running = serve(workers=2)
    good, bad = join(running.server.endpoint), join(running.server.endpoint)
    chance = random.Random(11)
    body = wire.encode([np.arange(50.0)])
    valid: list[wire.Message] = [
        Request(1, "served_sum", 5.0, 1, (), body.frames),
        Request(2, "served_sum", 5.0, 1, (bytes(32),), body.frames),
        Reply(3, "ok", body=body.frames),
        Blob(bytes(1000)),
        Hello({"a": "b"}, "1", 1024),
        Ping(4),
        Pong(4),
        Cancel(1),
    ]
    memory = resident_bytes()
    for n in range(2000):
        frames = [bytearray(frame) for frame in wire.pack(chance.choice(valid))]
        mutate(chance, frames)
        bad.socket.send_multipart(frames)
        while bad.socket.poll(0):
            bad.socket.recv_multipart()
        if n % 10 == 0:
            assert good.value(n, "served_sum", np.ones(5)) == 5
    until(lambda: running.server.status().running + running.server.status().queue_depth == 0)
    grown = resident_bytes() - memory
    assert grown < 50 * 2**20
    assert running.counted("dropped_messages_total", reason="malformed") > 500
    assert running.counted("blob_bytes") <= 2**20


def test_a_message_above_the_limit_is_dropped(serve: Serve, join: Join) -> None:
    """Many frames above the limit are dropped; a single frame above it closes that connection only."""
    running = serve(message_bytes_max=2**17)
    good, bad = join(running.server.endpoint), join(running.server.endpoint)
    bad.request(1, "served_sum", *[np.zeros(8000)] * 4)
    until(lambda: running.counted("dropped_messages_total", reason="malformed") == 1)
    bad.send(Blob(bytes(2**18)))
    assert good.value(1, "served_sum", np.ones(5)) == 5
    assert running.counted("blob_bytes") == 0


def test_the_reply_to_a_robot_that_left_is_dropped(serve: Serve, join: Join, pipe: Path) -> None:
    """It is counted, and other robots are served."""
    running = serve()
    leaver = Peer(running.server.endpoint)
    leaver.request(1, "served_pipe", str(pipe))
    until(lambda: running.server.status().running == 1)
    leaver.close()
    peer = join(running.server.endpoint)
    peer.request(1, "served_count")
    until(lambda: running.server.status().queue_depth == 1)
    pipe.write_text("go")
    assert peer.reply().status == "ok"
    assert running.counted("dropped_messages_total", reason="gone") == 1


def test_a_robot_that_does_not_read_does_not_stop_others(serve: Serve, join: Join) -> None:
    """Beyond a limit its replies are dropped and counted; the server never waits for it."""
    running = serve(workers=2, queue_max=50)
    deaf, good = Peer(running.server.endpoint, unread_max=1), join(running.server.endpoint)
    for n in range(600):
        deaf.request(n, "served_zeros", 100_000)
        assert n % 10 or good.value(n, "served_sum", np.ones(5)) == 5
    assert running.counted("dropped_messages_total", reason="not reading") > 0
    deaf.close()


def mutate(chance: random.Random, frames: list[bytearray]) -> None:
    at = chance.randrange(len(frames))
    match chance.randrange(6):
        case 0:
            frames[at] = bytearray(chance.randbytes(chance.randrange(300)))
        case 1:
            for _ in range(chance.randrange(1, 4)):
                if frames[at]:
                    frames[at][chance.randrange(len(frames[at]))] = chance.randrange(256)
        case 2:
            del frames[at][chance.randrange(len(frames[at]) + 1) :]
        case 3:
            frames += [bytearray(chance.randbytes(50))] * chance.randrange(1, 20)
        case 4:
            chance.shuffle(frames)
        case _:
            frames[:] = [bytearray(chance.randbytes(chance.randrange(2000)))]


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
