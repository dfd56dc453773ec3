"""Checks that the arguments and the result of a kind can be sent to a server, at its first call.

What can be sent is decided in `common.wire.values`.
"""

from typing import Any

from offboard.common.errors import BadValue
from offboard.common.tasks import Kind, Task
from offboard.common.wire.values import encode


class CrossingCheck:
    """Raises BadValue at the first call of a kind, even if that call runs onboard."""

    def __init__(self) -> None:
        self._checked: set[str] = set()

    def check_arguments(self, task: Task) -> None:
        if task.kind.name not in self._checked:
            _check(task.kind, "arguments", list(task.args))

    def check_result(self, kind: Kind, value: Any) -> None:
        """Check a result; later calls of this kind are not checked again."""
        if kind.name not in self._checked:
            _check(kind, "result", value)
            self._checked.add(kind.name)


def _check(kind: Kind, what: str, value: Any) -> None:
    try:
        encode(value, kind.types)
    except BadValue as error:
        raise BadValue(f"{what} of task {kind.name}: {error}") from error
