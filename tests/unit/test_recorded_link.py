"""The model of a recorded link, against the same rule written in numpy."""

import math
from pathlib import Path
from random import Random

import numpy as np
import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import SEGMENT_BYTES, Link, LinkConditions
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.relay.link.recorded_link import NEVER_S, Playback, Recording
from offboard.loadgen.relay.link.recording_file import read_recording

TIMES = (0.0, 1.0, 2.0, 4.0, 5.0)
RTT_MS = (20.0, 800.0, 30.0, 10.0)
MBPS = (8.0, 0.0, 0.8, 4.0)  # 1,000,000, 0, 100,000 and 500,000 bytes a second


def recording(**columns: tuple[float, ...]) -> Recording:
    return Recording("run.csv", "ab" * 32, TIMES, columns)


def played(
    begun_s: float = 0.0, *, repeats: bool = True, from_s: float = 0.0, **columns: tuple[float, ...]
) -> Playback:
    return Playback(recording(**columns), "up", from_s=from_s, repeats=repeats, begun_s=begun_s)


def pipe(playback: Playback, **conditions: float) -> Pipe:
    return Pipe(LinkConditions(recording=playback, **conditions), 1, 1, "up")  # type: ignore[arg-type]


def test_a_message_is_delayed_by_half_the_round_trip_of_its_time() -> None:
    """A value holds until the next row, and the recording starts again at its end."""
    link = played(100.0, rtt_ms=RTT_MS)
    for after_s, delay_ms in (
        (0.0, 10),
        (0.999, 10),
        (1.0, 400),
        (3.9, 15),
        (4.5, 5),
        (5.0, 10),
        (11.5, 400),
    ):
        assert link.delay_ms(100.0 + after_s) == delay_ms, after_s


def test_what_was_held_back_arrives_together() -> None:
    """In order: messages behind a late one come out with it, as numpy computes from the rows."""
    random = Random(5)
    sent = np.sort([random.uniform(0, 20) for _ in range(500)])
    rows = np.searchsorted(TIMES, sent % TIMES[-1], side="right") - 1
    expected = np.maximum.accumulate(sent + np.array(RTT_MS)[rows] / 2e3)
    line = pipe(played(rtt_ms=RTT_MS))
    assert [line.due(at, 40) for at in sent] == pytest.approx(expected)
    assert np.unique(expected).size < len(sent) - 20


def test_bytes_pass_at_the_rates_of_the_seconds_that_they_take() -> None:
    """Fine steps through the rates give the same end as the model, over several rounds of the recording."""
    random, step = Random(6), 1e-4
    grid = np.arange(0, 40, step)
    rates = 125_000 * np.array(MBPS)[np.searchsorted(TIMES, grid % TIMES[-1] + step / 2, side="right") - 1]
    through = np.concatenate([[0.0], np.cumsum(rates * step)])
    link = played(mbps=MBPS)
    for _ in range(200):
        at, size = random.uniform(0, 12), random.randrange(1, 4_000_000)
        begin = np.interp(at, np.append(grid, grid[-1] + step), through)
        end = grid[np.searchsorted(through, begin + size) - 1]
        assert link.sent_s(at, size) == pytest.approx(end, abs=3 * step), (at, size)


def test_a_rate_of_0_holds_everything_back() -> None:
    """Until the rate is above 0; it is not unlimited."""
    link = played(mbps=MBPS)
    assert link.sent_s(1.2, 1) == pytest.approx(2.0, abs=1e-4)
    assert link.sent_s(0.5, 500_001) == pytest.approx(2.0, abs=1e-4)
    assert link.sent_s(0.5, 500_000) == pytest.approx(1.0)  # the last byte that gets through before
    assert played(mbps=(0.0, 0.0, 0.0, 8.0)).sent_s(0.5, 2_500_000) == pytest.approx(14.5)


def test_the_last_row_holds_without_repeats() -> None:
    """After the end the last value holds for ever; a last rate of 0 lets nothing pass any more."""
    assert played(repeats=False, rtt_ms=RTT_MS).delay_ms(1e6) == 5
    ended = played(repeats=False, mbps=MBPS)
    assert ended.sent_s(4.9, 1_050_000) == pytest.approx(7.0)
    assert ended.sent_s(100.0, 500_000) == pytest.approx(101.0)
    assert played(repeats=False, mbps=(8.0, 0.0, 0.8, 0.0)).sent_s(3.9, 20_000) > NEVER_S


def test_a_recording_waits_at_its_place_until_it_begins() -> None:
    """The value of that place holds, or the first rate above 0, so that robots can connect."""
    waiting = played(math.inf, from_s=1.5, rtt_ms=RTT_MS, mbps=MBPS)
    assert (waiting.delay_ms(1e6), waiting.sent_s(1e6, 100_000)) == (400, 1e6 + 1)
    begun = Link(LinkConditions(recording=waiting)).begun(50.0).up.recording
    assert begun is not None
    assert (begun.delay_ms(50.4), begun.delay_ms(50.6)) == (400, 15)


def test_the_place_where_it_begins_is_in_the_recording() -> None:
    """Another one is refused with the length of the file."""
    with pytest.raises(ConfigError, match=r"from_s: 5 is not from 0 to below 5, the seconds of run\.csv"):
        played(from_s=5.0, rtt_ms=RTT_MS)


def test_a_chunk_is_a_segment_where_rates_are_recorded() -> None:
    """So the bytes of a long message come out one after the other, at the recorded rate."""
    line = pipe(played(mbps=MBPS))
    assert line.chunk_bytes(100_000) == SEGMENT_BYTES
    due = [line.due(0.0, line.chunk_bytes(1 << 20)) for _ in range(600)]
    assert due == pytest.approx([SEGMENT_BYTES * n / 1e6 for n in range(1, 601)])
    assert line.busy_until_s == due[-1]


def test_other_conditions_act_on_top() -> None:
    """A recorded delay leaves jitter and bandwidth to the link, a recorded rate leaves the delay."""
    line = pipe(played(rtt_ms=RTT_MS), bandwidth_mbps=0.8)
    assert line.due(0.0, 10_000) == pytest.approx(0.1 + 0.01)
    jittery = pipe(played(rtt_ms=RTT_MS), jitter_ms=1.0)
    drawn_ms = [jittery.due(0.0, SEGMENT_BYTES) and jittery.drawn_ms for _ in range(300)]
    assert (np.mean(drawn_ms), np.std(drawn_ms)) == (pytest.approx(10, abs=0.3), pytest.approx(1, abs=0.2))
    assert pipe(played(mbps=MBPS), delay_ms=7.0).due(0.0, 1000) == pytest.approx(0.001 + 0.007)


def test_a_long_message_meets_the_delays_of_its_time() -> None:
    """Each part is delayed by the value at the time when it begins to be sent."""
    line = pipe(played(rtt_ms=RTT_MS), bandwidth_mbps=0.8)
    assert line.due(0.5, 100_000) == pytest.approx(1.5 + 0.4, abs=0.02)
    assert pipe(played(rtt_ms=RTT_MS), bandwidth_mbps=0.8).due(0.5, 40_000) == pytest.approx(0.91)


def test_a_recorded_quantity_cannot_be_changed(tmp_path: Path) -> None:
    """One line says which file it is recorded in; the other conditions can be changed."""
    file = tmp_path / "run.csv"
    file.write_text("t_s,rtt_ms\n0,30\n")
    link = LinkFlags(recording=file, delay_ms=40).link
    assert (link.up.delay_ms, link.up.bandwidth_mbps) == (0, 400)
    assert link.changed({"loss": 0.1, "bandwidth_mbps": 3}).down.loss == 0.1
    with pytest.raises(ConfigError) as caught:
        link.changed({"delay_ms": 5})
    assert str(caught.value) == "up.delay_ms: cannot be changed, because it is recorded in run.csv"
    file.write_text("t_s,up_mbps\n0,30\n")
    link = LinkFlags(recording=file).link
    assert (link.up.bandwidth_mbps, link.down.bandwidth_mbps, link.down.recording) == (0, 400, None)
    with pytest.raises(ConfigError, match=r"up.bandwidth_mbps: cannot be changed"):
        link.changed({"bandwidth_mbps": 0})


def test_each_direction_has_its_own_file(tmp_path: Path) -> None:
    """As the two files that mahimahi has for a link."""
    (tmp_path / "lte.up").write_text("1\n2\n")
    (tmp_path / "lte.down").write_text("1\n1\n2\n2\n")
    link = LinkFlags(up_recording=tmp_path / "lte.up", down_recording=tmp_path / "lte.down").link
    assert link.up.recording is not None
    assert link.down.recording is not None
    assert link.up.recording.sent_s(0.0, 15_000) == pytest.approx(0.01)
    assert link.down.recording.sent_s(0.0, 15_000) == pytest.approx(0.005)


def test_a_link_shows_what_it_plays(tmp_path: Path) -> None:
    """With the hash of the file, so that results of different recordings are told apart."""
    file = tmp_path / "run.csv"
    file.write_text("t_s,rtt_ms\n0,30\n")
    shown = LinkFlags(recording=file, recording_repeats=False).link.up.shown()["recording"]
    assert shown == {
        "file": "run.csv",
        "sha256": read_recording(file).sha256,
        "columns": ["rtt_ms"],
        "from_s": 0.0,
        "repeats": False,
    }
    assert LinkFlags().link.up.shown()["recording"] is None


def test_what_is_not_recorded_is_told(tmp_path: Path) -> None:
    """Tables name the file with its columns, and the conditions that come from the link."""
    file = tmp_path / "run.csv"
    file.write_text("t_s,rtt_ms\n0,30\n")
    rest = "from [link], as it is not recorded"
    assert (
        LinkFlags(recording=file).link.told() == f"run.csv (rtt_ms); {rest}: 400 Mbit/s up, 400 Mbit/s down"
    )
    file.write_text("t_s,up_mbps\n0,3\n")
    told = LinkFlags(recording=file, bandwidth_mbps=0).link.told()
    assert told == f"run.csv (up_mbps); {rest}: 15 ms up, 15 ms down, no limit down"
    assert LinkFlags().link.told() is None
