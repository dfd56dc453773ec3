"""The conditions of a link as flags of `loadgen wan`; a scenario's [link] holds them under the same names."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.loadgen.relay.link.delay_samples import SAMPLES, read_samples
from offboard.loadgen.relay.link.link import BOUNDS, NAMES, Link, LinkConditions


def _both(name: str, default: Any, help: str) -> Any:
    """A condition of both directions."""
    least, most = BOUNDS.get(name, (None, None))
    choices = NAMES if name == "distribution" else None
    return setting(default, help, minimum=least, maximum=most, choices=choices)


def _up(name: str) -> Any:
    return _both(name, None, f"--{name.replace('_', '-')} from robot to cloud alone")


def _down(name: str) -> Any:
    return _both(name, None, f"--{name.replace('_', '-')} from cloud to robot alone")


@dataclass(frozen=True, slots=True)
class LinkFlags:
    """Each condition for both directions, and for one alone, which wins."""

    delay_ms: float = _both("delay_ms", 15.0, "delay one way, in each direction")
    jitter_ms: float = _both("jitter_ms", 0.0, "spread of the delay, in each direction")
    distribution: str | None = _both(
        "distribution", None, "how jitter is distributed (default: normal, or samples with --samples)"
    )
    correlation: float = _both("correlation", 0.0, "of the jitter of neighbouring segments, 0 to 1")
    samples: Path | None = _both("samples", None, "delays in ms, one a line, to add in place of jitter")
    bandwidth_mbps: float = _both("bandwidth_mbps", 400.0, "bandwidth of each direction; 0 is unlimited")
    loss: float = _both("loss", 0.0, "share of segments lost, 0 to 1; TCP sends them again after a stall")
    loss_burst: float = _both("loss_burst", 1.0, "mean segments lost in a row; 1 is independent loss")
    stall_ms: float = _both("stall_ms", 200.0, "how much later a lost segment comes; doubled if lost again")
    hang: bool = _both("hang", False, "accept and take everything, answer nothing")
    reset_after_ms: float = _both("reset_after_ms", 0.0, "reset connections after so long; 0 is never")
    truncate_bytes: int = _both("truncate_bytes", 0, "close connections after so many bytes; 0 is never")
    slow_close_ms: float = _both("slow_close_ms", 0.0, "how much later the end of a stream comes")

    up_delay_ms: float | None = _up("delay_ms")
    up_jitter_ms: float | None = _up("jitter_ms")
    up_distribution: str | None = _up("distribution")
    up_correlation: float | None = _up("correlation")
    up_samples: Path | None = _up("samples")
    up_bandwidth_mbps: float | None = _up("bandwidth_mbps")
    up_loss: float | None = _up("loss")
    up_loss_burst: float | None = _up("loss_burst")
    up_stall_ms: float | None = _up("stall_ms")
    up_hang: bool | None = _up("hang")
    up_reset_after_ms: float | None = _up("reset_after_ms")
    up_truncate_bytes: int | None = _up("truncate_bytes")
    up_slow_close_ms: float | None = _up("slow_close_ms")

    down_delay_ms: float | None = _down("delay_ms")
    down_jitter_ms: float | None = _down("jitter_ms")
    down_distribution: str | None = _down("distribution")
    down_correlation: float | None = _down("correlation")
    down_samples: Path | None = _down("samples")
    down_bandwidth_mbps: float | None = _down("bandwidth_mbps")
    down_loss: float | None = _down("loss")
    down_loss_burst: float | None = _down("loss_burst")
    down_stall_ms: float | None = _down("stall_ms")
    down_hang: bool | None = _down("hang")
    down_reset_after_ms: float | None = _down("reset_after_ms")
    down_truncate_bytes: int | None = _down("truncate_bytes")
    down_slow_close_ms: float | None = _down("slow_close_ms")

    def __post_init__(self) -> None:
        check(self)
        _ = self.link  # what only fits together is checked there

    @property
    def link(self) -> Link:
        """The conditions at start; reads the files of samples."""
        return Link(self._conditions("up"), self._conditions("down"))

    def _conditions(self, direction: str) -> LinkConditions:
        values = {}
        for name in (field.name for field in fields(LinkConditions) if field.name != "outage"):
            own = getattr(self, f"{direction}_{name}")
            values[name] = getattr(self, name) if own is None else own
        if values["samples"] is not None:
            values["samples"] = read_samples(values["samples"])
        values["samples"] = values["samples"] or ()
        values["distribution"] = values["distribution"] or (SAMPLES if values["samples"] else "normal")
        return LinkConditions(**values)


def as_flags(settings: Mapping[str, Any]) -> list[str]:
    """Settings by name as a command line."""
    flags = []
    for name, value in settings.items():
        name = name.replace("_", "-")
        switch = f"--{name}" if value else f"--no-{name}"
        flags.append(switch if isinstance(value, bool) else f"--{name}={value}")
    return flags
