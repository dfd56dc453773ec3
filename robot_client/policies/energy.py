"""What a task costs the robot's battery: a linear model of computing, sending and waiting.

Which site that makes better is decided by the objective `energy` in `objectives`.
"""

from dataclasses import dataclass

from offboard.common.config import check, setting


@dataclass(frozen=True)
class Energy:
    """The power and energy that a robot takes; measure your own robot for good values.

    The defaults: a Raspberry Pi 4 B draws 2.7 W idle and 6.4 W with all four cores busy (Geerling, Power
    Consumption Benchmarks, pidramble.com), so one core takes 0.9 W more; Wi-Fi takes 7 uJ per byte
    (Balasubramanian et al., Energy Consumption in Mobile Phones, IMC 2009, table 4).
    """

    compute_w: float = setting(0.9, "power that one busy core draws above idle, in watts", minimum=0.0)
    idle_w: float = setting(0.0, "power drawn while waiting for an answer, in watts", minimum=0.0)
    radio_j_byte: float = setting(7e-6, "energy per byte sent or received, in joules", minimum=0.0)

    def __post_init__(self) -> None:
        check(self)

    def onboard_j(self, cpu_s: float) -> float:
        """Joules of computing for `cpu_s` CPU seconds."""
        return self.compute_w * cpu_s

    def remote_j(self, seconds: float, bytes_moved: float) -> float:
        """Joules of waiting for `seconds`, and of sending and receiving the bytes."""
        return self.idle_w * seconds + self.radio_j_byte * bytes_moved
