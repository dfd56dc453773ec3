"""What others take of a simulated CPU quota, as a robot and a server read it."""

from offboard.common.host.load import FREE_MIN
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.processor import Processor


class SimulatedLoad:
    """What `host.load` would read of the quota, and of what is left of it the share of others."""

    def __init__(self, clock: VirtualClock, processor: Processor) -> None:
        self._clock = clock
        self._processor = processor
        self._read_at_s = self._own_s = self._others_s = self.latest = 0.0
        self.capacity = min(1.0, processor.cpus)

    def share(self, every_s: float) -> float:
        since_s = self._clock.now_s() - self._read_at_s
        if since_s >= every_s:
            self._processor.settle()
            self.capacity = min(1.0, self._processor.cpus)
            own_s, others_s = self._processor.own_s, self._processor.others_s
            took_s, left_s = others_s - self._others_s, self._processor.cpus * since_s - (own_s - self._own_s)
            self._own_s, self._others_s, self._read_at_s = own_s, others_s, self._clock.now_s()
            if left_s >= FREE_MIN * self._processor.cpus * since_s:
                self.latest = min(1.0, max(0.0, took_s / left_s))
        return self.latest
