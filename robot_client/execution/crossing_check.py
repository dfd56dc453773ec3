"""Says once in the log why calls of a kind can only be answered onboard: a value cannot be sent.

What can be sent is decided in `common.wire.values`.
"""

import logging
from collections.abc import Iterable
from typing import Any

from offboard.common.errors import BadValue, CannotCross, describe
from offboard.common.tasks import Kind, Task
from offboard.common.wire.values import encode
from offboard.robot_client.sites.runner import Execution

log = logging.getLogger(__name__)


class CrossingCheck:
    """Checks the values of the first call of each kind, even if it runs onboard, and hears of later ones."""

    def __init__(self) -> None:
        self._checked: set[str] = set()  # kinds
        self._logged: set[tuple[str, bool]] = set()  # kinds, and whether the task had run

    def check_arguments(self, task: Task) -> None:
        if task.kind.name not in self._checked and task.kind.pack is None:
            self._check(task.kind, list(task.args), ran=False)

    def check_result(self, kind: Kind, value: Any) -> None:
        """Check a result; later calls of this kind are not checked again."""
        if kind.name not in self._checked:
            self._checked.add(kind.name)
            self._check(kind, value, ran=True)

    def hear(self, kind: Kind, executions: Iterable[Execution]) -> None:
        for one in executions:
            if isinstance(one.failure, CannotCross):
                self._log(kind, str(one.failure), ran=one.started)

    def _check(self, kind: Kind, value: Any, *, ran: bool) -> None:
        if kind.policy_server:  # its sites may have another format; `hear` says what they cannot send
            return
        try:
            encode(value, kind.types, name="result" if ran else "arguments")
        except BadValue as error:
            self._log(kind, str(error), ran=ran)
        except Exception as error:  # noqa: BLE001 - such as a dict that another thread changes meanwhile
            self._log(kind, describe(error), ran=ran)

    def _log(self, kind: Kind, why: str, *, ran: bool) -> None:
        if (kind.name, ran) not in self._logged:
            self._logged.add((kind.name, ran))
            log.warning(
                "%s: only onboard can answer such a call: %s; remedy: change that value", kind.name, why
            )
