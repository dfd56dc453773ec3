"""What the host of this virtual machine takes of it: CPU time that was asked for here and went to others.

Such time makes every task longer, and no policy can do anything about it: runs that lost much of it do not
tell one policy from another.
"""

from pathlib import Path

STAT = Path("/proc/stat")
NOTED_PERCENT = 5.0  # from which on whoever reads figures of times is told


class Stolen:
    """The share of CPU time that the host kept since this was made (proc(5), "steal"); 0 on bare metal."""

    def __init__(self, stat: Path = STAT) -> None:
        self._stat = stat
        self._before = self._read()

    def percent(self) -> float | None:
        """Of the time that was asked for; None where the kernel does not tell."""
        now, before = self._read(), self._before
        if now is None or before is None:
            return None
        stolen, asked = now[0] - before[0], now[1] - before[1]
        return 100 * stolen / asked if asked > 0 else 0.0

    def _read(self) -> tuple[int, int] | None:
        """Ticks that were stolen, and those that were asked for, the stolen ones among them."""
        try:
            first = self._stat.read_text().split("\n", 1)[0].split()
            user, nice, system, _idle, _wait, irq, softirq, steal = map(int, first[1:9])
        except (OSError, ValueError):
            return None
        return steal, user + nice + system + irq + softirq + steal
