"""Reads what was measured of links: recordings over time, and delays; errors name file and line.

A recording is CSV with a header, or the packet times of mahimahi. What it does to messages is in
`recorded_link.py`.
"""

import functools
import hashlib
import logging
import math
import re
import stat
from array import array
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

from offboard.common.errors import DataError
from offboard.loadgen.relay.link.link import DELAY_MS_MAX, SAMPLES_MAX, Samples
from offboard.loadgen.relay.link.recorded_link import DOWN_MBPS, MBPS, RTT, UP_MBPS, Recording

ROWS_MAX = 1_000_000
BYTES_MAX = 128 << 20
KEPT_MAX = 4  # recordings that stay in memory, for a file that is named several times
GAP_S = 10.0  # a longer time without a row was not recorded
T_S_MAX = 1e7
MBPS_MAX = 100_000.0
PACKET_MBIT = 1500 * 8e-6  # of mahimahi, whose packets have 1,500 bytes
TIME = "t_s"
WHOLE = r"\s*[0-9]{1,12}\s*"
MOST = {RTT: 2 * DELAY_MS_MAX, MBPS: MBPS_MAX, UP_MBPS: MBPS_MAX, DOWN_MBPS: MBPS_MAX, TIME: T_S_MAX}
ALLOWED = "t_s,rtt_ms or t_s,mbps or t_s,down_mbps,up_mbps, or the packet times of mahimahi in whole ms"

log = logging.getLogger(__name__)


def read_recording(path: Path) -> Recording:
    """The recording in a file; DataError names file and line."""
    try:
        about = path.stat()  # a FIFO must not be opened: that waits for its writer
        if not stat.S_ISREG(about.st_mode):
            what = "a folder" if stat.S_ISDIR(about.st_mode) else "a FIFO or device"
            raise DataError(f"{path}: {what} is not a recording; give a file")
        return _read(path, about.st_mtime_ns, about.st_size)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from error


def read_samples(path: Path) -> Samples:
    """The delays of a file, one in each line, in ms; DataError names file, line and value."""
    try:
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    samples: list[float] = []
    for number, text in enumerate(map(str.strip, lines), 1):
        if text and len(samples) == SAMPLES_MAX:
            raise DataError(
                f"{path}:{number}: {text!r} is one delay too many; at most {SAMPLES_MAX} are allowed"
            )
        if text:
            samples.append(_value(f"{path}:{number}", text, DELAY_MS_MAX, "a delay in ms"))
    if not samples:
        raise DataError(f"{path}: the file holds no delays")
    return Samples(sorted(samples))


@functools.lru_cache(KEPT_MAX)
def _read(path: Path, _changed_ns: int, size: int) -> Recording:
    if size > BYTES_MAX:
        raise DataError(f"{path}: {size} bytes; a recording has at most {BYTES_MAX}")
    data = path.read_bytes()
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DataError(f"{path}:{line}: this is not text; a recording is {ALLOWED}") from None
    if not lines:
        raise DataError(f"{path}:1: the file is empty; a recording is {ALLOWED}")
    file, sha256 = path.name, hashlib.sha256(data).hexdigest()
    if re.fullmatch(WHOLE, lines[0]):
        return _checked(path, _packets(path, lines, file, sha256))
    return _checked(path, _table(path, lines, file, sha256))


def _table(path: Path, lines: Sequence[str], file: str, sha256: str) -> Recording:
    """A CSV file. A value holds until the next row; a long gap is cut out."""
    names = _columns(path, lines[0])
    columns = {name: array("d") for name in names}
    for number, line in _rows(path, lines, header=1):
        cells = line.split(",")
        if len(cells) != len(names):
            raise DataError(f"{path}:{number}: {len(cells)} values, but the header names {len(names)}")
        for name, text in zip(names, cells, strict=True):
            columns[name].append(_value(f"{path}:{number}: {name}", text, MOST[name]))
        if (at := columns[TIME])[-1] < at[max(0, len(at) - 2)]:
            raise DataError(f"{path}:{number}: t_s: {at[-1]:g} is before {at[-2]:g}, that of the row above")
    found = columns.pop(TIME)
    times, gaps, cut_s = _without_gaps(found)
    if gaps:
        log.warning(
            "%s: gaps of more than %g s that were cut out: %d, of %.1f s; remedy: add rows if it was silent",
            *(path, GAP_S, gaps, cut_s),
        )
    return Recording(file, sha256, times, columns)


def _columns(path: Path, header: str) -> list[str]:
    names = [name.strip() for name in header.split(",")]
    others = set(names) - {TIME}
    if len(set(names)) < len(names) or TIME not in names or not others or not others <= set(MOST):
        raise DataError(f"{path}:1: the first line {header[:80]!r} is no header; allowed: {ALLOWED}")
    if MBPS in names and others & {UP_MBPS, DOWN_MBPS}:
        raise DataError(f"{path}:1: {header[:80]!r}: {MBPS} is the rate of both directions; give it alone")
    return names


def _rows(path: Path, lines: Sequence[str], *, header: int) -> Iterator[tuple[int, str]]:
    """Each row after the `header` lines, with the number of its line; empty lines are skipped."""
    count = 0
    for number, line in enumerate(lines[header:], header + 1):
        if not line.strip():
            continue
        count += 1
        if count > ROWS_MAX:
            raise DataError(f"{path}:{number}: one row too many; a recording has at most {ROWS_MAX:,}")
        yield number, line
    if not count:
        raise DataError(f"{path}:1: no rows follow the header")


def _value(place: str, text: str, most: float, what: str = "a number") -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= most:
        raise DataError(f"{place}: {text.strip()[:40]!r} is not {what} from 0 to {most:g}")
    return value


def _without_gaps(found: Sequence[float]) -> tuple[Sequence[float], int, float]:
    """The times from 0 on with the end after the last one, the number of gaps, and the seconds cut out.

    The row before a gap and the last row hold for the usual time, which is the median of the others.
    """
    steps = [after - before for before, after in pairwise(found)]
    usual_s = median([step for step in steps if 0 < step <= GAP_S] or [GAP_S])
    times, gaps, cut_s = array("d", [0.0]), 0, 0.0
    for step in (*steps, usual_s):
        if step > GAP_S:
            gaps, cut_s, step = gaps + 1, cut_s + step - usual_s, usual_s
        times.append(times[-1] + step)
    return times, gaps, cut_s


def _packets(path: Path, lines: Sequence[str], file: str, sha256: str) -> Recording:
    """The times of mahimahi: in each of these milliseconds one packet more can be sent, else nothing."""
    times, mbps = array("d"), array("d")
    end_ms = 0
    for number, text in _rows(path, lines, header=0):
        if not re.fullmatch(WHOLE, text) or int(text) > 1e3 * T_S_MAX:
            raise DataError(f"{path}:{number}: {text.strip()[:40]!r} is not a time in whole ms")
        at_ms = max(1, int(text))
        if at_ms < end_ms:
            raise DataError(f"{path}:{number}: {at_ms} is before {end_ms}, that of the packet above")
        if at_ms > end_ms + 1:  # silence
            times.append(end_ms / 1e3)
            mbps.append(0.0)
        if at_ms > end_ms:
            times.append((at_ms - 1) / 1e3)
            mbps.append(0.0)
        mbps[-1] += PACKET_MBIT * 1e3
        end_ms = at_ms
    times.append(end_ms / 1e3)
    return Recording(file, sha256, times, {MBPS: mbps})


def _checked(path: Path, recording: Recording) -> Recording:
    """DataError if nothing can ever pass."""
    for name, values in recording.columns.items():
        if name != RTT and not any(
            value and after > before
            for value, before, after in zip(values, recording.times, recording.times[1:], strict=False)
        ):
            raise DataError(f"{path}: {name} is never above 0, so nothing would ever arrive")
    return recording
