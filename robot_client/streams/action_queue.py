"""The queue of actions: what is played at which step, and what becomes of a chunk that arrives.

    step        0    1    2    3    4    5    6    7
    played      a0   a1   a2   a3   b2   b3   b4   b5
                |         |         |
                seen: a   seen: b   chunk b arrives: b0 and b1 have passed

When chunks are asked for is in `asking`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import BadValue, describe

Actions = NDArray[Any]  # (steps, dimensions)


class Chunk(NamedTuple):
    """The actions of one answer.

    first: the step of the observation, for which the first action is. seen_s: when it was seen.
    """

    actions: Actions
    first: int
    seen_s: float
    site: str
    quality: float = 1.0

    @property
    def end(self) -> int:
        """The step after the last action."""
        return self.first + len(self.actions)


class Placed(NamedTuple):
    """What became of a chunk.

    dropped: how many of its steps had passed. seam: the largest change of one dimension from the last action
    before the chunk to its first one; None if nothing was played before.
    """

    dropped: int
    seam: float | None


class ActionQueue:
    """One writer at a time; `playing` may be read at any moment, by any thread.

    blend: over how many steps the old actions turn into the new ones; 0: at once.
    """

    def __init__(self, blend: int = 0) -> None:
        self.playing: Chunk | None = None
        self._blend = blend
        self._shape: tuple[int, ...] | None = None

    def left(self, step: int) -> int:
        """For how many steps from this one there are actions."""
        return 0 if self.playing is None else max(0, self.playing.end - step)

    def upcoming(self, step: int, count: int) -> Actions:
        """The actions that are played from this step on, at most `count`."""
        chunk = self.playing
        if chunk is None:
            return np.empty((0, *(self._shape or (0,))))
        return chunk.actions[max(0, step - chunk.first) :][:count]

    def put(self, chunk: Chunk, step: int) -> Placed | None:
        """Play this chunk from this step on; None: it is too old, and dropped whole."""
        old = self.playing
        if chunk.end <= step or (old is not None and chunk.first <= old.first):
            return None
        self._shape = chunk.actions.shape[1:]
        dropped, seam = max(0, step - chunk.first), None
        if old is not None and len(before := old.actions[: max(0, step - old.first)]):
            if self._blend and old.end > step:
                chunk = chunk._replace(actions=_blended(old, chunk, step, self._blend))
            seam = float(np.max(np.abs(chunk.actions[dropped] - before[-1])))
        self.playing = chunk
        return Placed(dropped, seam)

    def clear(self) -> None:
        """Play nothing more; the next chunk may have other dimensions."""
        self.playing = self._shape = None

    def checked(self, value: Any, read: Callable[[Any], Any] | None) -> Actions:
        """The actions of an answer. BadValue unless they are finite numbers of the usual dimensions.

        `read`: makes the array of the answer; None: it is `answer["actions"]`, or the answer itself.
        """
        try:
            if read is not None:
                value = read(value)
            elif isinstance(value, dict):
                value = value["actions"]
            actions = np.array(value, dtype=np.float64)
        except Exception as error:  # `read` is the user's own, and so is the answer
            raise BadValue(f"actions of the answer: {describe(error)}") from error
        if actions.ndim < 2 or not actions.size:
            raise BadValue(f"actions of the answer: shape {actions.shape}; it must be (steps, dimensions)")
        if self._shape is not None and actions.shape[1:] != self._shape:
            raise BadValue(f"actions of the answer: {actions.shape[1:]} in a step, but {self._shape} before")
        if not np.isfinite(actions).all():
            raise BadValue("actions of the answer: some are not finite")
        actions.flags.writeable = False
        return actions


def _blended(old: Chunk, new: Chunk, step: int, steps: int) -> Actions:
    """The new actions, which begin at the old ones and leave them within `steps`."""
    actions = new.actions.copy()
    count = min(steps, old.end - step, new.end - step)
    share = (np.arange(count) + 1.0) / (steps + 1.0)
    share = share.reshape(-1, *([1] * (actions.ndim - 1)))
    first, before = step - new.first, step - old.first
    actions[first : first + count] *= share
    actions[first : first + count] += (1.0 - share) * old.actions[before : before + count]
    return actions
