"""The conditions of a network link, in both directions, as values that are checked when they are made.

What they do to bytes is computed in `pipe.py`. What an outage and a hang stop:

              outage (the link is silent)           hang (the receiving side is frozen)
    read      no: bytes wait in the sender          yes: bytes are read and lost
    deliver   no: bytes come after the outage       no
    connect   waits for the end of the outage       waits while the cloud hangs
    reset     waits for the end of the outage       at once

An outage goes first: while it lasts, a hang reads nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.draws import DISTRIBUTIONS, LOSS_BURST_MAX, SAMPLES
from offboard.loadgen.relay.link.recorded_link import Playback

SEGMENT_BYTES = 1448  # payload of one TCP segment on Ethernet: 1500 - 20 (IP) - 32 (TCP with timestamps)
DELAY_MS_MAX = 60_000.0
SAMPLES_MAX = 20_000
BANDWIDTH_MBPS_MAX = 100_000.0
RESET_MS_MAX = 86_400_000.0
TRUNCATE_BYTES_MAX = 1 << 50
NAMES = (*DISTRIBUTIONS, SAMPLES)

# Lowest and highest value of each condition that is a number.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "delay_ms": (0, DELAY_MS_MAX),
    "jitter_ms": (0, DELAY_MS_MAX),
    "bandwidth_mbps": (0, BANDWIDTH_MBPS_MAX),
    "correlation": (0, 1),
    "loss": (0, 1),
    "loss_burst": (1, LOSS_BURST_MAX),
    "stall_ms": (0, DELAY_MS_MAX),
    "reset_after_ms": (0, RESET_MS_MAX),
    "truncate_bytes": (0, TRUNCATE_BYTES_MAX),
    "slow_close_ms": (0, DELAY_MS_MAX),
}


class Samples(tuple[float, ...]):
    """Measured delays in ms, checked and sorted."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """The conditions of one direction of a link.

    - `bandwidth_mbps`: 0 means unlimited; `reset_after_ms` and `truncate_bytes`: 0 means never.
    - `samples`: measured delays in ms; with distribution "samples" one of them is added to `delay_ms`, and
      `jitter_ms` is not used.
    - `outage`: nothing comes out until the outage ends. The link is silent; connections are not reset.
    - `hang`: the receiving side reads everything and answers nothing. What it read is lost, so when it wakes
      up, the connections that lost bytes are reset.
    - `recording`: its delay and rate are used instead of `delay_ms` and `bandwidth_mbps`, which are 0 then.
    """

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    distribution: str = "normal"
    bandwidth_mbps: float = 0.0
    outage: bool = False
    correlation: float = 0.0
    samples: tuple[float, ...] = ()
    loss: float = 0.0
    loss_burst: float = 1.0
    stall_ms: float = 200.0
    hang: bool = False
    reset_after_ms: float = 0.0
    truncate_bytes: int = 0
    slow_close_ms: float = 0.0
    recording: Playback | None = None

    def __post_init__(self) -> None:
        for name, (least, most) in BOUNDS.items():
            _check_number(name, getattr(self, name), least, most)
        if type(self.truncate_bytes) is not int:
            raise ConfigError(f"truncate_bytes: {self.truncate_bytes!r} is not a whole number")
        for name in ("outage", "hang"):
            if not isinstance(getattr(self, name), bool):
                raise ConfigError(f"{name}: {getattr(self, name)!r} is neither true nor false")
        if not isinstance(self.samples, Samples):  # a list comes from JSON or TOML
            self._check_samples()
        if self.distribution not in NAMES:
            raise ConfigError(f"distribution: {self.distribution!r} is not one of {', '.join(NAMES)}")
        if self.distribution == SAMPLES and not self.samples:
            raise ConfigError("samples: the list is empty, but distribution 'samples' needs delays")

    def _check_samples(self) -> None:
        if not isinstance(self.samples, list | tuple):
            raise ConfigError(f"samples: {self.samples!r} is not a list of delays in ms")
        if len(self.samples) > SAMPLES_MAX:
            raise ConfigError(f"samples: {len(self.samples)} delays; at most {SAMPLES_MAX} are allowed")
        for value in self.samples:
            _check_number("samples", value, 0, DELAY_MS_MAX)
        object.__setattr__(self, "samples", Samples(sorted(self.samples)))

    @property
    def swallows(self) -> bool:
        """Whether bytes of this direction are read and lost."""
        return self.hang and not self.outage

    @property
    def varies(self) -> bool:
        """Whether segments have different delays."""
        return self.jitter_ms > 0 or self.distribution == SAMPLES

    def delay_at_ms(self, enters_s: float) -> float:
        """The delay of bytes that enter then, without jitter."""
        return self.delay_ms + (self.recording.delay_ms(enters_s) if self.recording else 0.0)

    def shown(self) -> dict[str, Any]:
        """All conditions by name, for people and files; of the samples only their number."""
        played = None if self.recording is None else self.recording.shown()
        values = {name: getattr(self, name) for name in CONDITIONS}
        return values | {"samples": len(self.samples), "recording": played}

    def begun(self, at_s: float) -> "LinkConditions":
        """The same conditions, with the recording beginning then."""
        played = self.recording
        return self if played is None else replace(self, recording=replace(played, begun_s=at_s))


# The conditions that can be changed on a running link.
CONDITIONS = tuple(f.name for f in fields(LinkConditions) if f.name != "recording")


@dataclass(frozen=True, slots=True)
class Link:
    """Both directions of a link: `up` is robot to cloud, `down` is cloud to robot."""

    up: LinkConditions = field(default_factory=LinkConditions)
    down: LinkConditions = field(default_factory=LinkConditions)

    def changed(self, changes: Mapping[str, Any]) -> "Link":
        """This link with some conditions changed.

        `up` and `down` in `changes` hold the conditions of one direction; every other name changes both.
        """
        both = {name: value for name, value in changes.items() if name not in ("up", "down")}
        return Link(
            up=_changed("up", self.up, both | dict(changes.get("up") or {})),
            down=_changed("down", self.down, both | dict(changes.get("down") or {})),
        )

    @property
    def connects(self) -> bool:
        """Whether a new connection gets through to the cloud."""
        return self.resets and not self.up.hang

    @property
    def resets(self) -> bool:
        """Whether a reset gets through: it is a message too."""
        return not (self.up.outage or self.down.outage)

    @property
    def recorded(self) -> bool:
        return self.up.recording is not None or self.down.recording is not None

    def told(self) -> str | None:
        """What is played, and what the conditions say because it is not recorded; None: no recording."""
        files, others = {}, []
        for way, conditions in (("up", self.up), ("down", self.down)):
            played = conditions.recording
            replaced = () if played is None else played.replaced()
            if played is not None:
                files[played.recording.file] = ", ".join(played.recording.columns)
            if "delay_ms" not in replaced:
                others.append(f"{conditions.delay_ms:g} ms {way}")
            if "bandwidth_mbps" not in replaced:
                rate = f"{conditions.bandwidth_mbps:g} Mbit/s" if conditions.bandwidth_mbps else "no limit"
                others.append(f"{rate} {way}")
        if not files:
            return None
        names = " and ".join(f"{file} ({columns})" for file, columns in files.items())
        return f"{names}; from [link], as it is not recorded: {', '.join(others) or 'nothing'}"

    def begun(self, at_s: float) -> "Link":
        """The same link, with its recordings beginning then."""
        return Link(self.up.begun(at_s), self.down.begun(at_s))


def _changed(direction: str, conditions: LinkConditions, changes: Mapping[str, Any]) -> LinkConditions:
    played = () if conditions.recording is None else conditions.recording.replaced()
    for name in changes:
        if name not in CONDITIONS:
            raise ConfigError(f"{name}: unknown condition; known: {', '.join(CONDITIONS)}, up, down")
        if name in played:
            assert conditions.recording is not None
            file = conditions.recording.recording.file
            raise ConfigError(f"{direction}.{name}: cannot be changed, because it is recorded in {file}")
    try:
        return replace(conditions, **changes)
    except ConfigError as error:
        raise ConfigError(f"{direction}.{error}") from None


def _check_number(name: str, value: object, least: float, most: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and least <= value <= most):  # type: ignore[operator]
        raise ConfigError(f"{name}: {value!r} is not a number from {least:g} to {most:g}")
