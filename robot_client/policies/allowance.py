"""What tasks may still spend: second runs, bytes and joules, each in a token bucket.

The wrappers `probe`, `hedge` and `budget` ask for what is left; the offloader takes what is spent.
"""

import math

from offboard.common.token_bucket import Bucket
from offboard.robot_client.predictors.base import WARM_UP

DUPLICATES = 0.1  # second runs per task
DUPLICATES_MAX = float(WARM_UP)  # second runs: at the start, saved up, and owed; a warm-up takes as many


class Allowance:
    """The allowance of one robot. Called under the offloader's lock.

    `duplicates`: second runs per task in the long run, from 0 to 1.
    `first`: further second runs at the start.
    What a warm-up owes is limited: if a server is always busy, the warm-up may never end, and probes must
    still come.
    `bytes_a_minute`, `joules_a_minute`: caps (None: no cap). At most the amount of one minute is saved up.
    """

    def __init__(
        self,
        duplicates: float = DUPLICATES,
        bytes_a_minute: float | None = None,
        joules_a_minute: float | None = None,
        *,
        first: float = DUPLICATES_MAX,
    ) -> None:
        self._second = Bucket(duplicates, DUPLICATES_MAX, first if duplicates else 0.0)
        self._bytes, self._joules = _of_a_minute(bytes_a_minute), _of_a_minute(joules_a_minute)
        self._at_s: float | None = None

    @property
    def capped(self) -> bool:
        return self._bytes is not None or self._joules is not None

    @property
    def duplicates(self) -> float:
        """Second runs that may start now; below 0 while they are owed."""
        return self._second.level

    @property
    def bytes_left(self) -> float:
        return math.inf if self._bytes is None else self._bytes.level

    @property
    def joules_left(self) -> float:
        return math.inf if self._joules is None else self._joules.level

    def begin(self, now_s: float) -> None:
        """A task starts: it adds its share of a second run, and the caps refill with the time."""
        self._second.fill(1.0)
        if not self.capped:
            return
        since_s = 0.0 if self._at_s is None else max(0.0, now_s - self._at_s)
        self._at_s = now_s
        for bucket in (self._bytes, self._joules):
            if bucket is not None:
                bucket.fill(since_s)

    def duplicate(self) -> None:
        """A second run of a task starts."""
        self._second.take(1.0)
        self._second.level = max(-DUPLICATES_MAX, self._second.level)

    def take_duplicate(self) -> bool:
        """Whether a second run may start; it is then counted."""
        allowed = self.duplicates >= 1
        if allowed:
            self.duplicate()
        return allowed

    def spend(self, bytes_moved: float, joules: float) -> None:
        """An execution took these bytes and joules."""
        if self._bytes is not None:
            self._bytes.take(bytes_moved)
        if self._joules is not None:
            self._joules.take(joules)


def _of_a_minute(cap: float | None) -> Bucket | None:
    return None if cap is None else Bucket(cap / 60.0, cap, cap)
