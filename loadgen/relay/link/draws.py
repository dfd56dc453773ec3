"""Random numbers that belong to the segments of a byte stream, in whatever order they are asked for.

What the numbers mean is left to `jitter.py` and `loss.py`.
"""

import math
import random

REPLAY_MAX = 100_000  # segments that are drawn again at most, which takes about 40 ms
_SKIP = 1 << 16  # numbers skipped at a time
_FLOAT_BITS = 64  # that one float takes from the generator


class Draws:
    """One uniform number in (0, 1) for each segment.

    `origin` is the seed: another origin gives independent numbers.
    """

    def __init__(self, origin: str) -> None:
        self._origin = origin
        self._random: random.Random | None = None  # made when it is needed: many connections never draw
        self._number = -1
        self._value = 0.5

    def at(self, number: int) -> float:
        """The number of this segment. Going forward is fast, going back starts again from the seed."""
        if self._random is None or number < self._number:
            self._random, self._number = random.Random(self._origin), -1
        if number != self._number:
            self._skip(self._random, number - self._number - 1)
            # Distributions have infinite quantiles at 0 and 1.
            self._value, self._number = min(1 - self._random.random(), 1 - 2**-53), number
        return self._value

    @staticmethod
    def _skip(generator: random.Random, count: int) -> None:
        while count:
            part = min(count, _SKIP)
            generator.getrandbits(_FLOAT_BITS * part)
            count -= part


def replay_from(number: int, memory: float) -> int:
    """The segment from which a random process must be replayed to know its state at segment `number`.

    `memory` is the share of its state that the process keeps from one segment to the next. Earlier segments
    change the state by less than a rounding error. Only a memory above 0.9996 is cut short, by REPLAY_MAX.
    """
    if memory <= 0:
        return number
    steps = REPLAY_MAX if memory >= 1 else min(REPLAY_MAX, math.ceil(math.log(2**-53) / math.log(memory)))
    return max(0, number - steps)
