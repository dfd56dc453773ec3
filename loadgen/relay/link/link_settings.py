"""The conditions of a link as flags of `loadgen wan`; the [link] table of a scenario uses the same names.

What a condition does to the data is in `link`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.loadgen.relay.link.draws import SAMPLES
from offboard.loadgen.relay.link.link import BOUNDS, CONDITIONS, NAMES, Link, LinkConditions
from offboard.loadgen.relay.link.recorded_link import Playback
from offboard.loadgen.relay.link.recording_file import T_S_MAX, read_recording, read_samples

LINK, FAULTS, UP, DOWN = "link", "faults", "from robot to cloud only", "from cloud to robot only"
RECORDED = "recorded link"


def _both(name: str, default: Any, help: str, *, group: str = LINK, rare: bool = False) -> Any:
    least, most = BOUNDS.get(name, (None, None))
    choices = NAMES if name == "distribution" else None
    return setting(default, help, group=group, rare=rare, minimum=least, maximum=most, choices=choices)


def _up(name: str) -> Any:
    return _both(name, None, f"--{name.replace('_', '-')} {UP}", group=UP, rare=True)


def _down(name: str) -> Any:
    return _both(name, None, f"--{name.replace('_', '-')} {DOWN}", group=DOWN, rare=True)


@dataclass(frozen=True)
class LinkFlags:
    """Each condition for both directions, and for each direction alone, which takes precedence."""

    delay_ms: float = _both("delay_ms", 15.0, "delay in each direction, in ms")
    jitter_ms: float = _both("jitter_ms", 0.0, "spread of the delay, in ms")
    distribution: str | None = _both(
        "distribution",
        None,
        "distribution of the jitter (default: normal, or samples with --samples)",
        rare=True,
    )
    correlation: float = _both(
        "correlation", 0.0, "correlation between the jitter of neighbouring segments, 0 to 1", rare=True
    )
    samples: Path | None = _both(
        "samples", None, "file of delays in ms, one per line, that are added instead of jitter", rare=True
    )
    bandwidth_mbps: float = _both(
        "bandwidth_mbps", 400.0, "bandwidth of each direction, in Mbit/s; 0 is unlimited"
    )
    loss: float = _both("loss", 0.0, "share of segments lost, 0 to 1; TCP sends them again after --stall-ms")
    loss_burst: float = _both(
        "loss_burst", 1.0, "mean number of segments lost in a row; 1 is independent loss", rare=True
    )
    stall_ms: float = _both(
        "stall_ms", 200.0, "delay of a lost segment, in ms; doubled if it is lost again", rare=True
    )
    hang: bool = _both("hang", False, "accept connections and data, but deliver nothing", group=FAULTS)
    reset_after_ms: float = _both(
        "reset_after_ms",
        0.0,
        "reset each connection after this time, in ms; 0 is never",
        group=FAULTS,
        rare=True,
    )
    truncate_bytes: int = _both(
        "truncate_bytes",
        0,
        "close each connection after this many bytes; 0 is never",
        group=FAULTS,
        rare=True,
    )
    slow_close_ms: float = _both(
        "slow_close_ms", 0.0, "delay of the end of a stream, in ms", group=FAULTS, rare=True
    )

    recording: Path | None = setting(
        None,
        "recorded link to play: CSV with t_s and rtt_ms, mbps, or down_mbps and up_mbps, or the packet times"
        " of mahimahi; what is recorded replaces the delay or bandwidth",
        group=RECORDED,
    )
    up_recording: Path | None = setting(None, f"--recording {UP}", group=RECORDED, rare=True)
    down_recording: Path | None = setting(None, f"--recording {DOWN}", group=RECORDED, rare=True)
    recording_from_s: float = setting(
        0.0,
        "second of the recording at which it begins",
        group=RECORDED,
        rare=True,
        minimum=0.0,
        maximum=T_S_MAX,
    )
    recording_repeats: bool = setting(
        True,
        "start again at the end of the recording; without it, the last row holds",
        group=RECORDED,
        rare=True,
    )

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
        _ = self.link  # checks that the conditions fit together

    @property
    def link(self) -> Link:
        """The conditions at start; reads the files of --samples and --recording."""
        return Link(self._conditions("up"), self._conditions("down"))

    def _conditions(self, direction: str) -> LinkConditions:
        values = {}
        for name in CONDITIONS:
            if name == "outage":  # only a running link has one
                continue
            own = getattr(self, f"{direction}_{name}")
            values[name] = getattr(self, name) if own is None else own
        if values["samples"] is not None:
            values["samples"] = read_samples(values["samples"])
        values["samples"] = values["samples"] or ()
        values["distribution"] = values["distribution"] or (SAMPLES if values["samples"] else "normal")
        played = self._playback(direction)
        if played is not None:
            values |= dict.fromkeys(played.replaced(), 0.0)
        return LinkConditions(**values, recording=played)

    def _playback(self, direction: str) -> Playback | None:
        """The recording of one direction; None if there is none, or if it says nothing of this direction."""
        file = getattr(self, f"{direction}_recording") or self.recording
        if file is None:
            return None
        played = Playback(
            read_recording(file), direction, from_s=self.recording_from_s, repeats=self.recording_repeats
        )
        return played if played.replaced() else None


def as_flags(settings: Mapping[str, Any]) -> list[str]:
    flags = []
    for name, value in settings.items():
        name = name.replace("_", "-")
        switch = f"--{name}" if value else f"--no-{name}"
        flags.append(switch if isinstance(value, bool) else f"--{name}={value}")
    return flags
