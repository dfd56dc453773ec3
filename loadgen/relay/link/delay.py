"""The delay of one direction: the fixed delay, plus jitter or a measured delay, for each segment.

Pure. The random draw of a segment comes from `jitter.py`.
"""

from offboard.loadgen.relay.link.delay_samples import SAMPLES, quantile
from offboard.loadgen.relay.link.jitter import DISTRIBUTIONS, Jitter
from offboard.loadgen.relay.link.link import LinkConditions


class Delay:
    """The delays of the segments of one direction, drawn from the seed `origin`."""

    def __init__(self, origin: str) -> None:
        self._jitter = Jitter(origin)

    def at_ms(self, segment: int, conditions: LinkConditions, recorded_ms: float = 0.0) -> float:
        """How long this segment takes under these conditions, in ms; never less than 0."""
        fixed_ms = conditions.delay_ms + recorded_ms
        if not varies(conditions):
            return fixed_ms
        draw = self._jitter.at(segment, conditions.correlation)
        if conditions.distribution == SAMPLES:
            return fixed_ms + quantile(conditions.samples, draw)
        jitter_ms = conditions.jitter_ms * DISTRIBUTIONS[conditions.distribution](draw)
        return max(0.0, fixed_ms + jitter_ms)


def varies(conditions: LinkConditions) -> bool:
    """Whether segments have different delays."""
    return conditions.jitter_ms > 0 or conditions.distribution == SAMPLES
