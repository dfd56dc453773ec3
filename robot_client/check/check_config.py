"""The settings of `robot-client check`."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting


@dataclass(frozen=True)
class CheckConfig:
    """How a server is checked."""

    keys: Path | None = setting(
        None,
        "folder with robot.key_secret and server.key, as for `Offloader.connect(keys=...)`",
        metavar="DIR",
    )
    tasks: tuple[str, ...] = setting(
        (),
        "modules whose tasks must be the same on the server (default: the planner, if both sides have it)",
        metavar="MODULE,MODULE",
    )
    timeout_s: float = setting(
        5.0, "time that each step may take, in seconds", name="timeout", minimum=0.1, maximum=3600
    )

    def __post_init__(self) -> None:
        check(self)
