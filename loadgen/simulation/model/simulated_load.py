"""The load of a simulated computer, as its robot or server would measure it."""

from offboard.common.host.load import FREE_MIN
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock


class SimulatedLoad:
    """What `offboard.common.host.load` would measure: the CPU quota, and the share that other programs take.

    `latest` is that share of the CPU time that our own work leaves; `capacity` is the quota, at most 1 CPU.
    """

    def __init__(self, clock: VirtualClock, cpu: SimulatedCpu) -> None:
        self._clock = clock
        self._cpu = cpu
        self._read_at_s = self._own_s = self._others_s = self.latest = 0.0
        self.capacity = min(1.0, cpu.cpus)

    def share(self, every_s: float) -> float:
        """The share of other programs, measured again if the last measurement is `every_s` old."""
        since_s = self._clock.now_s() - self._read_at_s
        if since_s >= every_s:
            self._cpu.settle()
            self.capacity = min(1.0, self._cpu.cpus)
            own_s, others_s = self._cpu.own_s, self._cpu.others_s
            took_s, left_s = others_s - self._others_s, self._cpu.cpus * since_s - (own_s - self._own_s)
            self._own_s, self._others_s, self._read_at_s = own_s, others_s, self._clock.now_s()
            if left_s >= FREE_MIN * self._cpu.cpus * since_s:
                self.latest = min(1.0, max(0.0, took_s / left_s))
        return self.latest
