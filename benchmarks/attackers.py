"""Attacks on a server, each by a process that is held to half a core.

`python -m benchmarks.attackers NAME ENDPOINT HTTP_PORT KEYS` goes on until its input ends, then says how many
steps it made. The attacker has the keys of a robot that the server knows: who has none gets less far.
"""

import contextlib
import itertools
import pickle
import random
import select
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Point, Pose, Scan, plan_path
from offboard.common.security.keys import ROBOT, make_keys, robot_keys
from offboard.common.tasks import kind_of
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.runner import CLOUD

SHARE = 0.5  # of a core
SEND_S = 0.05  # longest wait for the server to read
CONNECTIONS = 200  # held open by who is slow
IDLE = 5_000  # connections
PART_BYTES = 1 << 20
SEED = 1
EXT_BLOB, EXT_DATACLASS = 2, 3  # msgpack extensions of offboard.common.wire.values
PLAIN_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)  # ZMTP 3.0
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"


@dataclass(frozen=True, slots=True)
class Target:
    """A server, and the folder with the keys of a robot that it knows (None: it has no keys)."""

    endpoint: str
    http_port: int
    keys: Path | None

    @property
    def port(self) -> int:
        return int(self.endpoint.rpartition(":")[2])


Frames = list[Any]
Attack = Callable[[Target], Generator[None]]


def main() -> None:
    name, endpoint, http_port, keys = sys.argv[1:]
    target = Target(endpoint, int(http_port), Path(keys) if keys else None)
    attack, steps = ATTACKS[name](target), 0
    began, used = time.monotonic(), time.process_time()
    for _ in attack:
        steps += 1
        ahead = time.process_time() - used - SHARE * (time.monotonic() - began)
        if select.select([sys.stdin], [], [], max(0.0, ahead / SHARE))[0]:
            break
    attack.close()
    print(steps, flush=True)


@contextlib.contextmanager
def dealer(target: Target, keys: Path | None = None) -> Iterator["zmq.Socket[bytes]"]:
    """A socket that libzmq connects again whenever the server ends the connection."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as client:
        prepare(client, keys or target.keys)
        client.connect(target.endpoint)
        yield client


def prepare(client: "zmq.Socket[bytes]", keys: Path | None) -> None:
    client.linger = 0
    client.sndtimeo = int(SEND_S * 1000)
    if keys is not None:
        mine = robot_keys(keys, CLOUD)
        client.curve_publickey, client.curve_secretkey = mine.own.public, mine.own.secret
        client.curve_serverkey = mine.server


def say(client: "zmq.Socket[bytes]", frames: Frames) -> None:
    """Send, unless the server takes no more; forget what it answers."""
    with contextlib.suppress(zmq.Again):
        client.send_multipart(frames)
    with contextlib.suppress(zmq.Again):
        while True:
            client.recv_multipart(zmq.DONTWAIT)


def garbage(target: Target) -> Generator[None]:
    """Frames of random bytes."""
    rng = random.Random(SEED)
    with dealer(target) as client:
        while True:
            say(client, [rng.randbytes(rng.choice((0, 1, 20, 2_000))) for _ in range(rng.randint(1, 4))])
            yield


def mutated(target: Target) -> Generator[None]:
    """Frames of good messages in which something is changed."""
    rng = random.Random(SEED)
    good = valid_messages()
    with dealer(target) as client:
        while True:
            say(client, mutate(rng.choice(good), rng))
            yield


def valid_messages() -> list[Frames]:
    """One of each kind that a robot sends, and plans with all that a plan may have."""
    kind = kind_of(plan_path)
    cells = np.zeros((20, 30), np.int8)
    scan = Scan(np.full(8, 2.5, np.float32), 0.0, 0.7, 10.0)
    arguments = (
        GridMap(cells, 0.1),
        scan,
        Pose(0.5, 0.5, 0.1),
        Point(2.5, 1.5),
        0.1,
        cells.astype(np.uint8),
        "astar",
    )
    large = wire.encode(list(arguments), kind.types, blobs=True)
    small = wire.encode(list(arguments), kind.types)
    blob = np.zeros(wire.BLOB_BYTES_MIN + 1, np.uint8)
    named = wire.encode(
        [GridMap(blob.reshape(1, -1).view(np.int8), 0.1), *arguments[1:]], kind.types, blobs=True
    )
    digest = next(iter(named.blobs))
    messages: list[wire.Message] = [
        wire.Hello({kind.name: kind.source_hash}, "0.1.0", 1 << 20),
        wire.Request(1, kind.name, 1.0, 1, (), small.frames),
        wire.Request(2, kind.name, 1.0, 1, tuple(large.blobs), large.frames),
        wire.Request(3, kind.name, 1.0, 2, (digest,), named.frames),
        wire.Blob(named.blobs[digest]),
        wire.Ping(4),
        wire.Cancel(1),
        wire.Reply(1, "ok", body=small.frames),
        wire.Pong(4, 1),
    ]
    return [[bytes(frame) for frame in wire.pack(message)] for message in messages]


def mutate(frames: Frames, rng: random.Random) -> Frames:
    """Up to four changes: bits, bytes, lengths, frames."""
    changed = [bytearray(frame) for frame in frames]
    for _ in range(rng.randint(1, 4)):
        frame = rng.choice(changed)
        at = rng.randrange(len(frame) + 1)
        what = rng.randrange(7)
        if what == 0 and frame:
            frame[at % len(frame)] ^= 1 << rng.randrange(8)
        elif what == 1 and frame:
            frame[at % len(frame)] = rng.choice((0x00, 0x7F, 0x80, 0x90, 0xC1, 0xC9, 0xDD, 0xDF, 0xFF))
        elif what == 2:
            del frame[at:]
        elif what == 3:
            frame[at:at] = rng.randbytes(rng.randint(1, 8))
        elif what == 4:
            frame[at:at] = rng.choice(
                (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")
            )
        elif what == 5:
            changed.insert(rng.randrange(len(changed) + 1), bytearray(rng.choice(changed)))
        elif len(changed) > 1:
            changed.pop(rng.randrange(len(changed)))
    return [bytes(frame) for frame in changed]


def request(body: Frames, kind: str = "plan_path", blobs: tuple[bytes, ...] = ()) -> Frames:
    return list(wire.pack(wire.Request(1, kind, 1.0, 1, blobs, body)))


def plan_body(grid: Any = None, pose: Any = None, scan: Any = None, radius_m: Any = 0.1) -> Frames:
    """Arguments of `plan_path` that need not be of its types."""
    grid = GridMap(np.zeros((20, 30), np.int8), 0.1) if grid is None else grid
    pose = Pose(0.5, 0.5) if pose is None else pose
    return wire.encode([grid, scan, pose, Point(2.5, 1.5), radius_m], kind_of(plan_path).types).frames


def array_of(shape: tuple[int, ...], data: bytes, dtype: str = "|i1") -> Frames:
    """A value that is one array in a frame of its own, of a shape that need not be true."""
    return [msgpack.packb(msgpack.ExtType(1, msgpack.packb((1, dtype, shape)))), data]


class _Reduced:
    """What a careless reader would call."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("import os; os._exit(66)",)


def bombs() -> dict[str, Frames]:
    """Small messages that would be large, or that would do something, were they believed."""
    code = pickle.dumps(_Reduced())
    nan, inf = float("nan"), float("inf")
    body = {
        "a million nested arrays": [b"\x91" * 1_000_000 + b"\xc0"],
        "a million nested maps": [b"\x81\x01" * 1_000_000 + b"\xc0"],
        "an array of 4 thousand million items": [b"\xdd\xff\xff\xff\xff"],
        "a text of 4 GB": [b"\xdb\xff\xff\xff\xff"],
        "extensions in extensions": [_nested_extension(60)],
        "a map of 10^9 cells in 10 bytes": plan_body_raw(array_of((31_623, 31_623), bytes(10))),
        "a shape that overflows": plan_body_raw(array_of((2**62, 2**62, 0), b"")),
        "a negative shape": plan_body_raw(array_of((-1, 4), bytes(4))),
        "objects as dtype": plan_body_raw(array_of((1,), bytes(8), "|O")),
        "nine dimensions": plan_body_raw(array_of((1,) * 9, bytes(1))),
        "a frame that is not there": [msgpack.packb([msgpack.ExtType(1, msgpack.packb((9, "|i1", (1,))))])],
        "NaN as a place": plan_body(pose=Pose(nan, inf)),
        "a negative radius": plan_body(radius_m=-1.0),
        "an endless radius": plan_body(radius_m=1e308),
        "NaN in a scan": plan_body(scan=Scan(np.full(8, nan, np.float32), nan, inf, -1.0)),
        "a scan of a million beams": plan_body(scan=Scan(np.ones(1_000_000, np.float32), 0.0, 1e-6, 9.0)),
        "a pickle": [code],
        "a pickle as an extension": [msgpack.packb([msgpack.ExtType(EXT_DATACLASS, code)])],
        "a dataclass of the standard library": [
            msgpack.packb([msgpack.ExtType(EXT_DATACLASS, msgpack.packb(["os.system", {"command": "id"}]))])
        ],
        "a blob that was not announced": [
            msgpack.packb([msgpack.ExtType(EXT_BLOB, msgpack.packb((bytes(32), "|i1", (1,))))])
        ],
    }
    requests = {name: request(frames) for name, frames in body.items()}
    fields = {"id": 1, "kind": "plan_path", "budget_s": nan, "attempt": 1, "blobs": []}
    header = msgpack.packb([1, "request", fields])
    return requests | {
        "a path as a task": request([b"\x90"], kind="../../../etc/passwd"),
        "a line break in a name": request(
            [b"\x90"], kind="x\n2026-01-01 00:00:00 INFO robots known: mallory"
        ),
        "a line break in a message type": [msgpack.packb([1, "ping\nINFO robots known: mallory\x1b[2J", {}])],
        "NaN as a budget": [header, b"\x90"],
        "a blob of another hash": request([b"\x90"], blobs=(bytes(32),)),
        "64 blobs that are not there": request([b"\x90"], blobs=tuple(bytes([n]) * 32 for n in range(64))),
        "a header of 65 KB": [msgpack.packb([1, "ping", {"id": 1, "x": bytes(65_536)}])],
        "two thousand frames": [msgpack.packb([1, "request", fields]), *[b"\x90"] * 2_000],
        "no frame after the header": [header],
        "an empty message": [b""],
        "a pickle as the header": [code],
    }


def plan_body_raw(array: Frames) -> Frames:
    """A plan whose map has this array for its cells."""
    grid = msgpack.packb(
        ["GridMap", {"cells": msgpack.unpackb(array[0]), "resolution": 0.1, "origin": [0.0, 0.0, 0.0]}]
    )
    rest = msgpack.unpackb(plan_body()[0])[1:]
    return [msgpack.packb([msgpack.ExtType(EXT_DATACLASS, grid), *rest]), array[1]]


def _nested_extension(depth: int) -> bytes:
    inner = b"\xc0"
    for _ in range(depth):
        inner = msgpack.packb(msgpack.ExtType(EXT_DATACLASS, inner))
    return inner


def bombing(target: Target) -> Generator[None]:
    """All bombs again and again."""
    with dealer(target) as client:
        for frames in itertools.cycle(bombs().values()):
            say(client, frames)
            yield


def claims(target: Target) -> Generator[None]:
    """Frames that claim to be of 4 GB, before and after a handshake."""
    huge = struct.pack(">BQ", 0x02, 2**32)  # a long frame
    command = struct.pack(">BQ", 0x06, 2**32)
    while True:
        for said in (PLAIN_GREETING + READY + huge, PLAIN_GREETING + command, curve_greeting() + command):
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", target.port), 1.0) as raw,
            ):
                raw.sendall(said)
                raw.sendall(bytes(1 << 16))
            yield


def curve_greeting() -> bytes:
    return PLAIN_GREETING.replace(b"NULL".ljust(20, b"\0"), b"CURVE".ljust(20, b"\0"))


def endless(target: Target) -> Generator[None]:
    """One message that never ends, of frames that are each small enough; in plain text.

    libzmq sends only whole messages, so this speaks ZMTP itself.
    """
    part = struct.pack(">BQ", 0x03, PART_BYTES) + bytes(PART_BYTES)  # a long frame, and more to come
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", target.port), 1.0) as raw:
            raw.sendall(PLAIN_GREETING + READY)
            while True:
                raw.sendall(part)
                yield
        yield


def strangers(target: Target) -> Generator[None]:
    """Handshakes without a key, with one that nobody knows, and in plain text."""
    with tempfile.TemporaryDirectory() as folder:
        unknown = Path(folder) / "unknown"
        make_keys(unknown, ROBOT)
        if target.keys is not None:
            (unknown / "server.key").write_bytes((target.keys / "server.key").read_bytes())
        while True:
            with zmq.Context() as context:
                for keys in (unknown if target.keys else None, None):
                    with context.socket(zmq.DEALER) as client:
                        prepare(client, keys)
                        client.connect(target.endpoint)
                        client.send(b"hello")
                        client.poll(int(SEND_S * 1000))
                        yield


def slow(target: Target) -> Generator[None]:
    """Many connections on both ports that say a byte now and then, and never all of it."""
    http = b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 4096
    said = {target.port: PLAIN_GREETING + READY, target.http_port: http}
    open_: dict[socket.socket, Iterator[int]] = {}
    try:
        while True:
            for port, text in said.items():
                if len(open_) < 2 * CONNECTIONS:
                    with contextlib.suppress(OSError):
                        open_[socket.create_connection(("127.0.0.1", port), 1.0)] = iter(text)
            for client, rest in list(open_.items()):
                try:
                    client.sendall(bytes([next(rest)]))
                except (OSError, StopIteration):
                    del open_[client]
                    client.close()
            time.sleep(0.01)
            yield
    finally:
        for client in open_:
            client.close()


def idle(target: Target) -> Generator[None]:
    """Connections with a good key that say nothing."""
    context = zmq.Context()
    context.set(zmq.MAX_SOCKETS, IDLE + 10)
    clients = []
    try:
        for _ in range(IDLE):
            client = context.socket(zmq.DEALER)
            prepare(client, target.keys)
            client.connect(target.endpoint)
            clients.append(client)
            yield
        while True:
            time.sleep(0.01)
            yield
    finally:
        context.destroy(linger=0)


def http(target: Target) -> Generator[None]:
    """Requests that are none, and far too long ones."""
    rng = random.Random(SEED)
    lines = (
        b"GET /../../etc/passwd HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /health HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n",
        b"GET /" + b"a" * 100_000,
        b"\x16\x03\x01\x02\x00",
    )
    while True:
        said = rng.choice((*lines, rng.randbytes(2_000)))
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", target.http_port), 1.0) as raw,
        ):
            raw.sendall(said)
        yield


def flood(target: Target) -> Generator[None]:
    """Good requests and pings without end."""
    plan, ping = request(plan_body()), list(wire.pack(wire.Ping(1)))
    with dealer(target) as client:
        while True:
            say(client, plan)
            say(client, ping)
            yield


def blobs(target: Target) -> Generator[None]:
    """Large arguments that nobody will use, each another one."""
    data = bytearray(1 << 20)
    with dealer(target) as client:
        for n in itertools.count():
            data[:8] = n.to_bytes(8, "little")
            say(client, list(wire.pack(wire.Blob(bytes(data)))))
            yield


ATTACKS: dict[str, Attack] = {
    "garbage": garbage,
    "mutated": mutated,
    "bombs": bombing,
    "claims": claims,
    "endless": endless,
    "strangers": strangers,
    "slow": slow,
    "idle": idle,
    "http": http,
    "flood": flood,
    "blobs": blobs,
}


if __name__ == "__main__":
    main()
