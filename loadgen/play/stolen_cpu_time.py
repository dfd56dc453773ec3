"""Stolen CPU time: the share of this virtual machine's CPU time that its host gave to others.

Stolen time makes every task longer, whatever the policy does, so runs that lost much of it cannot be
compared.
"""

from pathlib import Path

STAT = Path("/proc/stat")
NOTED_PERCENT = 5.0  # from this share on, it is reported with the times of a run


class StolenCpuTime:
    """Measures the share of stolen CPU time since it was created ("steal" in proc(5)); 0 on bare metal."""

    def __init__(self, stat: Path = STAT) -> None:
        self._stat = stat
        self._before = self._read()

    def percent(self) -> float | None:
        """The stolen share of the CPU time that was asked for, in percent.

        None if the kernel does not say.
        """
        now, before = self._read(), self._before
        if now is None or before is None:
            return None
        stolen, asked = now[0] - before[0], now[1] - before[1]
        return 100 * stolen / asked if asked > 0 else 0.0

    def _read(self) -> tuple[int, int] | None:
        """Stolen ticks, and all ticks that were asked for, stolen ones included."""
        try:
            first = self._stat.read_text().split("\n", 1)[0].split()
            user, nice, system, _idle, _wait, irq, softirq, steal = map(int, first[1:9])
        except (OSError, ValueError):
            return None
        return steal, user + nice + system + irq + softirq + steal
