"""Dataclasses for the tests of the wire format, and random damage to frames."""

import random
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Pose:
    x: float
    y: float
    tags: list[Any]


def mutate(chance: random.Random, frames: list[bytes]) -> None:
    """Replace, change, cut, add or shuffle frames."""
    at = chance.randrange(len(frames))
    frame = bytearray(frames[at])
    match chance.randrange(5):
        case 0:
            frames[at] = chance.randbytes(chance.randrange(200))
        case 1 if frame:
            frame[chance.randrange(len(frame))] = chance.randrange(256)
            frames[at] = bytes(frame)
        case 2:
            frames[at] = bytes(frame[: chance.randrange(len(frame) + 1)])
        case 3:
            frames.append(chance.randbytes(8))
        case _:
            chance.shuffle(frames)
