"""What may still be spent: second runs of tasks, bytes and joules; token buckets."""

import math

from offboard.common.errors import ConfigError
from offboard.common.token_bucket import Bucket

DUPLICATES = 0.1  # second runs a task
DUPLICATES_MAX = 6.0  # saved up at most, and owed at most
DUPLICATES_FIRST = 6.0  # there from the start: warm-up takes about so many
MINUTE_S = 60.0


class Allowance:
    """Of one robot. Called under the offloader's lock.

    Second runs: `duplicates` for each task in the long run, and the `first` beyond; a warm-up without
    end, as beside a server that is always busy, does not put off probes for ever.
    Caps: so many bytes and joules in a minute (None: no cap), a minute's worth at once at most.
    """

    def __init__(
        self,
        duplicates: float = DUPLICATES,
        bytes_a_minute: float | None = None,
        joules_a_minute: float | None = None,
        *,
        first: float = DUPLICATES_FIRST,
    ) -> None:
        if not 0 <= duplicates <= 1:
            raise ConfigError(f"duplicates {duplicates}: must be a share of tasks from 0 to 1")
        for name, cap in (("bytes", bytes_a_minute), ("joules", joules_a_minute)):
            if cap is not None and not cap >= 0:
                raise ConfigError(f"{name} a minute {cap}: must be from 0")
        self._second = Bucket(duplicates, DUPLICATES_MAX, first if duplicates else 0.0)
        self._bytes, self._joules = _minute(bytes_a_minute), _minute(joules_a_minute)
        self._at_s: float | None = None

    @property
    def capped(self) -> bool:
        return self._bytes is not None or self._joules is not None

    @property
    def duplicates(self) -> float:
        return self._second.level

    @property
    def bytes_left(self) -> float:
        return math.inf if self._bytes is None else self._bytes.level

    @property
    def joules_left(self) -> float:
        return math.inf if self._joules is None else self._joules.level

    def begin(self, now_s: float) -> None:
        """A task begins."""
        self._second.fill(1.0)
        if not self.capped:
            return
        since_s = 0.0 if self._at_s is None else max(0.0, now_s - self._at_s)
        self._at_s = now_s
        for bucket in (self._bytes, self._joules):
            if bucket is not None:
                bucket.fill(since_s)

    def duplicate(self) -> None:
        """A task runs on one site more."""
        self._second.take(1.0)
        self._second.level = max(-DUPLICATES_MAX, self._second.level)

    def spend(self, bytes_moved: float, joules: float) -> None:
        """An execution took this."""
        if self._bytes is not None:
            self._bytes.take(bytes_moved)
        if self._joules is not None:
            self._joules.take(joules)


def _minute(cap: float | None) -> Bucket | None:
    return None if cap is None else Bucket(cap / MINUTE_S, cap, cap)
