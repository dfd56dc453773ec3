"""The contracts of every predictor: it learns what happened on one site, and predicts what will.

Users write a `Predictor`. The core asks a `Model`, which knows more of a task; `plain` makes one of a
predictor. Where a task runs is decided in `policies`.
"""

import math
from typing import NamedTuple, Protocol

from offboard.common.tasks import Size
from offboard.robot_client.sites.runner import UNMEASURED, Condition

WARM_UP = 6  # runs of a site, after which its predictions are compared with those of others
REMEMBERED = 200  # observations of a site, sizes with their work, and probes
SIZE_MIN = 1e-100  # smaller differences of sizes are 0: a steeper line would leave the range of a float
ROUNDING = 1e-12  # smaller relative differences are rounding errors


class Prediction(NamedTuple):
    """What a task is expected to take.

    spread_s: standard deviation of the observed times around the prediction; None if unknown.
    error_s: standard error of `seconds` itself; None if unknown.
    """

    seconds: float
    spread_s: float | None
    error_s: float | None = None


class Predictor(Protocol):
    """Learns the times of one kind of task on one site. Only one thread at a time calls it.

    `copy.deepcopy` and pickle keep everything that it has learnt. Its window bounds its memory.
    """

    @property
    def full(self) -> bool:
        """Whether the warm-up of this site is over."""

    def __len__(self) -> int:
        """The number of observations that predictions use, at most the window."""

    def learn(self, size: float, seconds: float) -> None:
        """Learn one finished execution. ValueError unless both values are finite and not negative."""

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:
        """The prediction for a task of this size; None before the first observation.

        `ahead` counts tasks since the last one learnt. It is 1 for the next task, and more if this site did
        not run the tasks in between. Only predictors of a time series use it.
        """


class Call(NamedTuple):
    """A task that a site may run, or has run.

    amount: its size, or its work. moved: bytes there and back. condition: what was measured of the site.
    pack_s: how long packing takes before it is sent.
    ahead: tasks since the last one that was learnt, with this one.
    """

    amount: Size
    moved: float = 0.0
    condition: Condition = UNMEASURED
    pack_s: float = 0.0
    ahead: int = 1


class Run(NamedTuple):
    """What was measured of the run of a call.

    seconds: without the wait for other tasks of this robot, and without the packing, which took `pack_s`.
    ended: False: it was given up after these seconds, or failed.
    run_s, queue_s: what the site says that it ran and waited of these seconds; None: nothing.
    bound: the robot ran the same task itself and may have received the answer late.
    """

    seconds: float
    ended: bool = True
    run_s: float | None = None
    queue_s: float | None = None
    pack_s: float = 0.0
    bound: bool = False


class Model(Protocol):
    """The model of the times of one kind of task on one site, as the core asks it.

    learns_failures: a failed run counts as the time until it was given up. Otherwise only one that took
        longer than predicted says something: that its true time is longer still.
    """

    learns_failures: bool

    @property
    def full(self) -> bool:
        """Whether the warm-up of this site is over."""

    @property
    def byte_s(self) -> float | None:
        """The seconds that each byte takes on the way to this site; None if nothing says so."""

    def __len__(self) -> int:
        """The number of runs that predictions use."""

    def predict(self, call: Call) -> Prediction | None:
        """The prediction for a call; None before the first run."""

    def learn(self, call: Call, run: Run) -> None:
        """Learn one run."""


def check_observation(size: float, seconds: float) -> None:
    """The check that every `learn` starts with."""
    if not (0 <= size < math.inf and 0 <= seconds < math.inf):
        raise ValueError(f"observation ({size}, {seconds}): size and seconds must be finite and not negative")
