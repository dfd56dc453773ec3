"""Coverage-guided fuzzing of the messages of robots: `python -m tests.fuzz CORPUS [libFuzzer's flags]`.

An input holds the frames of one message, each preceded by its length. Reading any frames must give a message
or a ProtocolError; planning with any arguments must give a plan or an ordinary exception. Add
`-max_total_time=3600` to stop after an hour.
"""

import contextlib
import importlib
import struct
import sys
from pathlib import Path

import atheris

importlib.import_module(
    "offboard.common.planning.search"
)  # before the others: compiled code cannot be instrumented
with atheris.instrument_imports(
    include=[
        "msgpack",
        "offboard.common.wire.messages",
        "offboard.common.wire.values",
        "offboard.common.wire.blobs",
        "offboard.common.planning.planner",
    ]
):
    from offboard.common.errors import BadValue, ProtocolError
    from offboard.common.planning.planner import Plan, plan_path
    from offboard.common.tasks import kind_of
    from offboard.common.wire import messages as wire
    from offboard.common.wire.blobs import BlobStore

from benchmarks.attack_messages import Frames, bombs, valid_messages  # noqa: E402
from offboard.common.planning import planner  # noqa: E402

FRAMES_MAX = 40
SEED_BYTES_MAX = 4096  # larger bombs would only slow it down
LENGTH = struct.Struct("<H")


def joined(frames: Frames) -> bytes:
    return b"".join(LENGTH.pack(len(frame)) + frame for frame in frames)


def split(data: bytes) -> Frames:
    frames: Frames = []
    while len(data) >= LENGTH.size and len(frames) < FRAMES_MAX:
        (size,) = LENGTH.unpack_from(data)
        frames.append(data[LENGTH.size : LENGTH.size + size])
        data = data[LENGTH.size + size :]
    return frames


def check(data: bytes) -> None:
    """Read one message like the server, and its arguments like a worker."""
    frames = split(data)
    try:
        message = wire.unpack(frames)
    except ProtocolError:
        return
    assert wire.unpack(wire.pack(message)) == message
    if not isinstance(message, wire.Request | wire.Reply):
        return
    store, kind = BlobStore(1 << 20), kind_of(plan_path)
    digest = store.add(bytes(70_000))
    blob = store.get(digest)
    assert blob is not None
    digests = message.blobs if isinstance(message, wire.Request) else ()
    try:
        arguments = (
            wire.decode(message.body, kind.types, dict.fromkeys(digests, blob)) if message.body else []
        )
    except ProtocolError:
        return
    with contextlib.suppress(BadValue):  # for example one frame too many
        wire.encode(arguments, kind.types)
    if isinstance(message, wire.Request) and isinstance(arguments, list):
        with contextlib.suppress(Exception):  # raised by the task: the server would answer `failed`
            assert isinstance(plan_path(*arguments), Plan)


def main() -> None:
    corpus = Path(sys.argv[1])
    corpus.mkdir(parents=True, exist_ok=True)
    for n, frames in enumerate([*valid_messages(), *bombs().values()]):
        if sum(map(len, frames)) <= SEED_BYTES_MAX and len(frames) <= FRAMES_MAX:
            (corpus / f"seed-{n:02}").write_bytes(joined(frames))
    planner.warm()
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
