"""Hogs in a container: busy processes that compete with its part for the CPU quota."""

import time
from collections.abc import Sequence
from typing import Any

from offboard.common.errors import OffloadError

END_S = 10.0  # longest wait for the end of a hog


class ContainerHogs:
    """The hogs of one part since its last start; when the part ends, they end too.

    `api` is the low-level client of the Docker SDK, `container` the running container of the part.
    """

    def __init__(self, part: str, api: Any, container: Any) -> None:
        self._part = part
        self._api = api
        self._container = container
        self._ids: list[str] = []  # of the `docker exec` of each hog

    def set(self, count: int) -> None:
        """Start or end hogs until there are `count`."""
        while len(self._ids) > count:
            self._end_last()
        while len(self._ids) < count:
            made = self._api.exec_create(self._container.id, _begin(len(self._ids) + 1))
            self._api.exec_start(made["Id"], detach=True)
            self._ids.append(made["Id"])

    def _end_last(self) -> None:
        number, end_s = len(self._ids), time.monotonic() + END_S
        while self._api.exec_inspect(self._ids[-1])["Running"]:
            if time.monotonic() > end_s:
                raise OffloadError(f"{self._part}: hog {number} has not ended after {END_S:g} s")
            self._container.exec_run(_end(number))  # repeated: the hog may only just have begun
        self._ids.pop()


def _begin(number: int) -> Sequence[str]:
    """A command that keeps a CPU busy until the command `_end` with the same number is executed."""
    return ("sh", "-c", ': > "$0"; while [ -e "$0" ]; do :; done', f"/tmp/hog-{number}")


def _end(number: int) -> Sequence[str]:
    return ("rm", "-f", f"/tmp/hog-{number}")
