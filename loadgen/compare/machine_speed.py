"""Machine speed in a comparison: how much it differed between two policies' runs, and the ratio without it.

The time that a planning server needs for a task does not depend on the policy of the robot that asks. If the
server was slower in the runs of one policy, the machine was slower then. The ratio of mean times is corrected
by how strongly the two ratios vary together over resamples of the tasks (control variates; Lavenberg and
Welch 1981, "A perspective on the use of control variables to increase the efficiency of Monte Carlo
simulations").
"""

from collections.abc import Mapping

import numpy as np

from offboard.loadgen.table.measured_rows import Column

SLOPES = (0.0, 1.0)  # a machine that is twice as slow makes no task faster, and none more than twice as long


def speed_slope(resampled: Mapping[str, Column]) -> float:
    """The exponent with which `over_constant` follows `server_over_constant`; 0 if that never differs."""
    server, over = (np.log(resampled[name]) for name in ("server_over_constant", "over_constant"))
    known = np.isfinite(server) & np.isfinite(over)
    if not known.any() or not np.ptp(server[known]):
        return 0.0
    spread, together = np.cov(server[known], over[known])[0]
    return float(np.clip(together / spread, *SLOPES))


def at_one_speed(figures: Mapping[str, Column], slope: float) -> Column:
    """`over_constant` of each resample, as if the server had been equally fast in the runs of both policies.

    NaN if no task was sent to the cloud by both.
    """
    found: Column = figures["over_constant"] * np.exp(-slope * np.log(figures["server_over_constant"]))
    return found
