"""Hash tasks for scenarios: real CPU work on a number or a frame, with an answer that can be verified.

The server loads them with `--tasks offboard.loadgen.scenario.hash_tasks`.
The robot takes one with `--task offboard.loadgen.scenario.hash_tasks:NAME`. Those on frames and images have
many bytes that cannot be compressed, which `--inputs` makes.
"""

import hashlib
import os
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from offboard.common.task_call import check_wanted
from offboard.common.tasks import task
from offboard.loadgen.testbed.testbed import PART, ROBOT, kind_of

ROUNDS_MAX = 10_000_000
RARE = 25  # on each computer, one in this many sizes ...
MUCH = 20  # ... takes this many times as long
FRAME_BYTES = (100_000, 1_000_000)  # smallest and largest
IMAGE_BYTES = 900_000
BYTES_PER_ROUND = 10  # 1 MB takes about 25 ms on a whole CPU
IMAGE_ROUNDS = 80_000  # about 20 ms
WITHOUT_ACCELERATOR = 20  # times as many rounds on a robot
EVERYWHERE = "everywhere"  # stands for the computer where all have the same slow sizes

Bytes = NDArray[np.uint8]


@task("hash_rounds", size=float)
def hash_rounds(rounds: int) -> bytes:
    """PBKDF2-HMAC-SHA256 (RFC 8018) with this many rounds: the time is linear in the size."""
    return _hashed(rounds)


@task("hash_pairs", size=float)
def hash_pairs(count: int) -> bytes:
    """One round for every thousand pairs of `count` things: the time grows with the square of the size."""
    return _hashed(count * count // 1000)


@task("hash_rarely_long", size=float)
def hash_rarely_long(rounds: int) -> bytes:
    """Like `hash_rounds`, but 1 in RARE sizes takes MUCH times as long: other ones on each computer."""
    return _hashed_in_steps(rounds, rounds_on(os.environ.get(PART, ""), rounds))


@task("hash_rarely_long_everywhere", size=float)
def hash_rarely_long_everywhere(rounds: int) -> bytes:
    """Like `hash_rarely_long`, but every computer has the same slow sizes."""
    return _hashed_in_steps(rounds, rounds_on(EVERYWHERE, rounds))


@task("look_at_frame", size=lambda frame: float(frame.nbytes))
def look_at_frame(frame: Bytes) -> bytes:
    """Looks for something in a frame, as AprilTags or registration do: the time grows with the bytes."""
    return _hashed(frame_rounds(frame))


@task("look_at_any_frame", size=lambda _: 1.0)
def look_at_any_frame(frame: Bytes) -> bytes:
    """The same task with a size that says nothing: only the bytes tell what it takes."""
    return _hashed(frame_rounds(frame))


@task("judge_image", size=lambda image: float(image.nbytes))
def judge_image(image: Bytes) -> bytes:  # noqa: ARG001 - the time does not depend on it
    """A network on an image: WITHOUT_ACCELERATOR times slower on a robot than on the server."""
    return _hashed_in_steps(IMAGE_ROUNDS, image_rounds(os.environ.get(PART, "")))


def frames(seed: int) -> Iterator[Bytes]:
    """Frames of 0.1 to 1 MB."""
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, 256, random.integers(*FRAME_BYTES), np.uint8)


def images(seed: int) -> Iterator[Bytes]:
    """Images of 0.9 MB."""
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, 256, IMAGE_BYTES, np.uint8)


def frame_rounds(frame: Bytes) -> int:
    return frame.nbytes // BYTES_PER_ROUND


def image_rounds(part: str) -> int:
    return IMAGE_ROUNDS * (WITHOUT_ACCELERATOR if kind_of(part) == ROBOT else 1)


def rounds_on(part: str, rounds: int) -> int:
    """The rounds that `hash_rarely_long` computes on this part of a testbed; the tail is unpredictable."""
    rare = zlib.crc32(f"{part}/{rounds}".encode()) % RARE == 0
    return rounds * MUCH if rare else rounds


def _hashed_in_steps(rounds: int, total: int) -> bytes:
    """The hash of `rounds`, after other hashes until `total` rounds are done."""
    for _ in range(total // max(rounds, 1) - 1):
        check_wanted()
        _hashed(rounds)
    return _hashed(rounds)


def _hashed(rounds: int) -> bytes:
    """Runs without Python's interpreter lock."""
    if rounds > ROUNDS_MAX:
        raise ValueError(f"{rounds} rounds are over {ROUNDS_MAX}")
    return hashlib.pbkdf2_hmac("sha256", b"offboard", b"scenario", max(rounds, 1))
