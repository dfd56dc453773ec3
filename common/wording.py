"""Numbers and durations as people read them: three digits, and the unit that fits."""

import math

DIGITS = 3
SECONDS_FROM = 0.9995  # below it, three digits of milliseconds are at most 999
LEAST = 1e-4  # smaller numbers have an exponent, and smaller times are shown as 0


def rounded(value: float, digits: int = DIGITS) -> str:
    """A number rounded to this many digits, without an exponent unless it is very small."""
    if not math.isfinite(value) or abs(value) < LEAST:
        return f"{value:.{digits}g}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    text = f"{round(value, decimals):.{max(0, decimals)}f}"
    return text.rstrip("0").rstrip(".") if decimals > 0 else text


def duration(seconds: float) -> str:
    """Such as `44.7 ms` or `1.06 s`."""
    scale, unit = _unit_of(seconds)
    return f"{_time(scale * seconds)} {unit}"


def with_bounds(seconds: float, low_s: float, high_s: float, per: str = "") -> str:
    """A duration and its interval in the same unit, such as `1.06 s per task [0.4, 12]`."""
    scale, _ = _unit_of(seconds)
    said = f"{duration(seconds)} {per}".rstrip()
    return f"{said} [{_time(scale * low_s)}, {_time(scale * high_s)}]"


def with_interval(seconds: float, low_s: float, high_s: float) -> str:
    """A time that cannot be negative, and its interval, which may have an upper end only: `[up to 92.8]`."""
    scale, _ = _unit_of(seconds)
    if _time(scale * low_s) == "0":
        return f"{duration(seconds)} [up to {_time(scale * high_s)}]"
    return with_bounds(seconds, low_s, high_s)


def _unit_of(seconds: float) -> tuple[float, str]:
    return (1.0, "s") if abs(seconds) >= SECONDS_FROM else (1e3, "ms")


def _time(value: float) -> str:
    return "0" if abs(value) < LEAST else rounded(value)
