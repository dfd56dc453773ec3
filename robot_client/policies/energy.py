"""What a task costs the robot's battery: a linear model of computing, sending and waiting."""

from dataclasses import dataclass

from offboard.common.config import check, setting


@dataclass(frozen=True)
class Energy:
    """Joules of one task, onboard or elsewhere.

    Defaults: a Raspberry Pi 4 B draws 2.7 W idle and 6.4 W with all four cores busy (Geerling, Power
    Consumption Benchmarks, pidramble.com), so one core takes 0.9 W more; Wi-Fi takes 7 uJ a byte
    (Balasubramanian et al., Energy Consumption in Mobile Phones, IMC 2009, table 4). Measure your own.
    """

    compute_w: float = setting(0.9, "watts that one busy core takes above idle", minimum=0.0)
    idle_w: float = setting(0.0, "watts while waiting for an answer, where waiting is not free", minimum=0.0)
    radio_j_byte: float = setting(7e-6, "joules a byte sent or received", minimum=0.0)

    def __post_init__(self) -> None:
        check(self)

    def onboard_j(self, cpu_s: float) -> float:
        """Of computing for so many CPU seconds."""
        return self.compute_w * cpu_s

    def remote_j(self, seconds: float, bytes_moved: float) -> float:
        """Of sending and receiving so many bytes, and waiting."""
        return self.idle_w * seconds + self.radio_j_byte * bytes_moved
