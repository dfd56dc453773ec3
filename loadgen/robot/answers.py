"""The answers file: one JSON line per task, with its answer and its times; a run that died continues from it.

What is asked, and when, is decided in `run`.
"""

import base64
import hashlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import DataError, ProtocolError
from offboard.common.wire.values import decode, encode
from offboard.loadgen.robot_files import read_fields
from offboard.robot_client.records.lines import VERSION, Lines

if TYPE_CHECKING:  # importing the planner compiles it, which a robot without a map does not need
    from offboard.common.planning.planner import Plan

BEGIN_S = 0.25
WHOLE_BYTES_MAX = 16 * 1024  # of an answer that the file holds whole
# (row, col) of each step. The index of a step is its digit in the file: eighths of a turn, from the direction
# of the row (x of the map) towards higher rows (y of the map).
STEPS = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
_OFFSETS = np.array(STEPS, np.int32)
_NINE = np.array((3, 1), np.int32)  # dot product with a step to a neighbour: -4 to 4, used as an index
_DIGITS = np.full(9, ord("?"), np.uint8)
_DIGITS[_OFFSETS @ _NINE] = [ord(str(digit)) for digit in range(len(STEPS))]
STRAY = "the path steps to a cell that is not a neighbour"
_FIELDS = ("i", "id", "due_s", "began_s", "ended_s", "error", "answer")


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer to task `i`. `id` is the id of its record; times are in s after the first task was due."""

    i: int
    id: str | None
    due_s: float
    began_s: float
    ended_s: float
    error: str | None
    answer: Mapping[str, Any] | None


class Answers:
    """The answers of one run in the file `path`; `done` are the tasks that an earlier run answered there.

    `begin` creates the file: a bench that waits for the run to begin can wait for the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.done: frozenset[int] = frozenset()
        self._lines: Lines | None = None
        if path.exists():
            self.begin()
            try:
                self.done = frozenset(fields["i"] for fields in read(path))
            except DataError:
                self.close()
                raise

    @property
    def lost(self) -> int:
        """Number of answers that could not be written."""
        return self._lines.lost if self._lines else 0

    def begin(self) -> None:
        """Create the file, BEGIN_S before the first task is due, which gives a waiting bench time to act."""
        if self._lines is None:
            new = not self.path.exists()
            self._lines = Lines("answers", self.path)
            time.sleep(BEGIN_S if new else 0.0)

    def write(self, answered: Answered) -> None:
        assert self._lines is not None, "not begun"
        self._lines.append(answered.i, {"v": VERSION, **{name: getattr(answered, name) for name in _FIELDS}})

    def close(self) -> None:
        if self._lines:
            self._lines.close()


def read(path: Path) -> Iterator[dict[str, Any]]:
    """The fields of each line, as `read_trace` returns them; `i` is checked to be a whole number from 0."""
    for fields in read_fields(path, _FIELDS):
        if type(fields["i"]) is not int or fields["i"] < 0:
            raise DataError(f"{path}: i = {json.dumps(fields['i'])} is not a task number")
        yield fields


def of_plan(plan: "Plan") -> dict[str, Any]:
    """A plan as a line of the file holds it; `cells_of` restores every cell of the path."""
    start = [int(place) for place in plan.cells[0]] if len(plan.cells) else None
    return {
        "status": plan.status,
        "cost": plan.cost,
        "expanded": plan.expanded,
        "start": start,
        "steps": _steps(plan.cells),
    }


def of_value(value: Any, types: Sequence[type], *, whole: bool = False) -> dict[str, Any]:
    """Any other result as a line holds it: the SHA-256 of its bytes on the wire, arrays included.

    With `whole` it also holds these bytes, in Base64, unless they are over WHOLE_BYTES_MAX.
    """
    digest, frames = hashlib.sha256(), encode(value, types).frames
    for frame in frames:
        digest.update(frame)
    found: dict[str, Any] = {"sha256": digest.hexdigest()}
    if whole and sum(memoryview(frame).nbytes for frame in frames) <= WHOLE_BYTES_MAX:
        found["frames"] = [base64.b64encode(frame).decode() for frame in frames]
    return found


def value_of(answer: Mapping[str, Any], types: Sequence[type]) -> Any:
    """The result that `of_value` kept whole; a DataError if it cannot be restored."""
    try:
        return decode([base64.b64decode(text) for text in answer["frames"]], types, {})
    except (ProtocolError, ValueError, TypeError) as error:
        raise DataError(f"answer {answer['sha256']}: its frames cannot be read: {error}") from error


def cells_of(answer: Mapping[str, Any]) -> NDArray[np.int32]:
    """The cells (row, col) of the path of a plan, K x 2, from its start and its steps."""
    if answer["start"] is None:
        return np.zeros((0, 2), np.int32)
    digits = np.frombuffer(answer["steps"].encode(), np.uint8) - ord("0")
    if (digits >= len(STEPS)).any():
        raise DataError(f"steps {answer['steps']!r:.80} contain a character other than 0 to {len(STEPS) - 1}")
    return np.concatenate((np.array([answer["start"]], np.int32), _OFFSETS[digits])).cumsum(0, np.int32)


def _steps(cells: NDArray[np.int32]) -> str:
    moves = cells[1:] - cells[:-1]
    if moves.size and max(moves.max(), -moves.min()) > 1:
        raise DataError(STRAY)
    digits: bytes = _DIGITS[moves @ _NINE].tobytes()
    if b"?" in digits:
        raise DataError(STRAY)
    return digits.decode()
