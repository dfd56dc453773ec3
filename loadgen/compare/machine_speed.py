"""The machine's speed in a comparison: how much it differed between two policies' runs, and a ratio without.

What a planning server takes for a task does not depend on who asks for it. Where it took longer for the same
tasks in the runs of one policy, the machine was slower then, and its ratio of means is taken back by as much
as the two ratios vary together over resamples of tasks (control variates; Lavenberg and Welch 1981, "A
perspective on the use of control variables to increase the efficiency of Monte Carlo simulations").
"""

from collections.abc import Mapping

import numpy as np

from offboard.loadgen.table.rows import Column

SLOPES = (0.0, 1.0)  # a machine that is twice as slow makes no task quicker, and none more than twice as long


def speed_slope(resampled: Mapping[str, Column]) -> float:
    """By what power of `server_over_first` the `over_first` of resamples goes; 0 where that never differs."""
    server, over = (np.log(resampled[name]) for name in ("server_over_first", "over_first"))
    known = np.isfinite(server) & np.isfinite(over)
    if not known.any() or not np.ptp(server[known]):
        return 0.0
    spread, together = np.cov(server[known], over[known])[0]
    return float(np.clip(together / spread, *SLOPES))


def at_one_speed(figures: Mapping[str, Column], slope: float) -> Column:
    """`over_first` of each resample as if the server had taken as long in both policies' runs; NaN where no
    task was sent there in both."""
    found: Column = figures["over_first"] * np.exp(-slope * np.log(figures["server_over_first"]))
    return found
