"""One direction of a link: delay, jitter, loss, bandwidth and order, computed from given times."""

import itertools
import math
import random
import statistics
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.loadgen.relay.link.draws import DISTRIBUTIONS, Jitter, Loss, stall_ms
from offboard.loadgen.relay.link.link import SEGMENT_BYTES, LinkConditions
from offboard.loadgen.relay.link.pipe import BUCKET_S, CHUNK_BYTES, Pipe

SEEDS = st.integers(0, 2**32)
CUTS = st.lists(st.integers(1, 5 * SEGMENT_BYTES), min_size=1, max_size=20)
DEVIATION = {"constant": 0, "uniform": 1 / math.sqrt(3), "normal": 1, "pareto": 1, "lognormal": 1}
MEAN = {
    "constant": 1,
    "uniform": 0,
    "normal": 0,
    "pareto": 1 / math.sqrt(3),
    "lognormal": 1 / math.sqrt(math.e - 1),
}


def test_delay_without_jitter_is_exact() -> None:
    """A chunk comes out exactly one delay after it arrived."""
    assert Pipe(LinkConditions(delay_ms=15), 0, 0, "up").due(100.0, 5000) == 100.015


@given(bandwidth_mbps=st.floats(0.1, 1000), sizes=CUTS)
def test_bandwidth_is_exact(bandwidth_mbps: float, sizes: list[int]) -> None:
    """A chunk comes out when all bits up to its last one were sent, plus the delay."""
    pipe = Pipe(LinkConditions(delay_ms=10, bandwidth_mbps=bandwidth_mbps), 0, 0, "up")
    for size, total in zip(sizes, itertools.accumulate(sizes), strict=True):
        due_s = pipe.due(0.0, size)
        assert due_s == pytest.approx(0.010 + total * 8 / (bandwidth_mbps * 1e6), rel=1e-9)


def test_an_idle_link_saves_up_no_bandwidth() -> None:
    """A chunk after a pause takes its full sending time."""
    pipe = Pipe(LinkConditions(bandwidth_mbps=8), 0, 0, "up")
    assert pipe.due(0.0, 1000) == pytest.approx(0.001)
    assert pipe.due(5.0, 1000) == pytest.approx(5.001)
    assert pipe.due(5.0, 1000) == pytest.approx(5.002)


@given(seed=SEEDS, distribution=st.sampled_from(list(DISTRIBUTIONS)), sizes=CUTS)
def test_draws_do_not_depend_on_how_bytes_are_cut(seed: int, distribution: str, sizes: list[int]) -> None:
    """The same bytes at the same time come out at the same time, in whatever chunks they arrived."""
    conditions = LinkConditions(50, 5, distribution, 100)
    whole, cut = (Pipe(conditions, seed, 3, "down") for _ in range(2))
    assert [cut.due(1.0, size) for size in sizes][-1] == pytest.approx(whole.due(1.0, sum(sizes)), abs=1e-9)
    assert cut.due(9.0, SEGMENT_BYTES) == pytest.approx(whole.due(9.0, SEGMENT_BYTES), abs=1e-9)


@given(seed=SEEDS, sizes=CUTS)
def test_draws_do_not_depend_on_earlier_conditions(seed: int, sizes: list[int]) -> None:
    """The draw of a segment does not depend on the conditions that earlier segments had."""
    calm, rough = (Pipe(LinkConditions(50, 5, name), seed, 0, "up") for name in ("constant", "lognormal"))
    calm.conditions = LinkConditions()
    for size in sizes:
        calm.due(0.0, size)
        rough.due(0.0, size)
    calm.conditions = rough.conditions = LinkConditions(50, 5, "normal")
    assert calm.due(1e6, SEGMENT_BYTES) == rough.due(1e6, SEGMENT_BYTES)


@given(seed=SEEDS, distribution=st.sampled_from(list(DISTRIBUTIONS)), sizes=CUTS, gap_s=st.floats(0, 0.01))
def test_order_is_kept(seed: int, distribution: str, sizes: list[int], gap_s: float) -> None:
    """No chunk comes out before an earlier chunk, or before it arrived."""
    pipe = Pipe(LinkConditions(5, 20, distribution), seed, 0, "up")
    arrived = [n * gap_s for n in range(len(sizes))]
    due = [pipe.due(arrived_s, size) for arrived_s, size in zip(arrived, sizes, strict=True)]
    assert due == sorted(due)
    assert all(due_s >= arrived_s for due_s, arrived_s in zip(due, arrived, strict=True))


def test_seed_connection_and_direction_each_matter() -> None:
    """The same seed, connection and direction give the same draws; changing any of them gives others."""

    def draws(*origin: Any) -> tuple[float, ...]:
        pipe = Pipe(LinkConditions(50, 5), *origin)
        return tuple(pipe.due(float(n), SEGMENT_BYTES) for n in range(5))

    assert draws(1, 2, "up") == draws(1, 2, "up")
    assert len({draws(1, 2, "up"), draws(0, 2, "up"), draws(1, 1, "up"), draws(1, 2, "down")}) == 4


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_distributions_have_the_stated_mean_and_deviation(distribution: str) -> None:
    """The jitter of 50,000 segments has the mean and standard deviation of its distribution."""
    pipe = Pipe(LinkConditions(1000, 10, distribution), 1, 0, "up")
    jitter = [(pipe.due(n * 1e4, SEGMENT_BYTES) - n * 1e4 - 1.0) / 0.010 for n in range(50_000)]
    assert statistics.mean(jitter) == pytest.approx(MEAN[distribution], abs=0.03)
    assert statistics.pstdev(jitter) == pytest.approx(DEVIATION[distribution], rel=0.15, abs=1e-6)


def test_the_random_numbers_of_jitter_stay_the_same() -> None:
    """Segment n uses number n of the generator that is seeded with seed, connection and direction."""
    generator = random.Random("9/2/down")
    draws = [1 - generator.random() for _ in range(100)]
    pipe = Pipe(LinkConditions(50, 5, "uniform"), 9, 2, "down")
    for n, draw in enumerate(draws):
        assert pipe.due(float(n), SEGMENT_BYTES) - n == pytest.approx((50 + 5 * (2 * draw - 1)) / 1e3)


@given(seed=SEEDS, sizes=CUTS, burst=st.sampled_from([1.0, 5.0]), correlation=st.sampled_from([0.0, 0.7]))
def test_all_effects_together_do_not_depend_on_cuts(
    seed: int, sizes: list[int], burst: float, correlation: float
) -> None:
    """With all effects on, the same bytes come out at the same time, in whatever chunks they arrived."""
    conditions = LinkConditions(
        50, 5, "pareto", 100, correlation=correlation, loss=0.3, loss_burst=burst, slow_close_ms=7
    )
    whole, cut = (Pipe(conditions, seed, 3, "down") for _ in range(2))
    assert [cut.due(1.0, size) for size in sizes][-1] == pytest.approx(whole.due(1.0, sum(sizes)), abs=1e-9)
    assert cut.due(900.0, SEGMENT_BYTES) == pytest.approx(whole.due(900.0, SEGMENT_BYTES), abs=1e-9)
    assert cut.due(1800.0, 0) == pytest.approx(whole.due(1800.0, 0), abs=1e-9)


EFFECTS = {
    "jitter": {"jitter_ms": 5.0},
    "correlation": {"jitter_ms": 5.0, "correlation": 0.8},
    "samples": {"distribution": "samples", "samples": (1.0, 4.0, 9.0)},
    "loss": {"loss": 0.2},
    "bursts": {"loss": 0.2, "loss_burst": 4.0},
    "bandwidth": {"bandwidth_mbps": 8.0},
}


@given(
    seed=SEEDS,
    before=st.lists(st.sampled_from(list(EFFECTS)), max_size=20),
    now=st.sampled_from(list(EFFECTS)),
)
def test_earlier_effects_change_no_draw(seed: int, before: list[str], now: str) -> None:
    """A segment gets the same delay and stall, whichever effects earlier segments had."""
    changing, steady = (Pipe(LinkConditions(20, **EFFECTS[now]), seed, 1, "up") for _ in range(2))
    for n, name in enumerate(before):
        changing.conditions = LinkConditions(20, **EFFECTS[name])
        changing.due(n * 1e3, SEGMENT_BYTES)
        steady.due(n * 1e3, SEGMENT_BYTES)
    changing.conditions = steady.conditions
    for n in range(5):
        assert changing.due(1e6 + n * 1e3, SEGMENT_BYTES) == pytest.approx(
            steady.due(1e6 + n * 1e3, SEGMENT_BYTES), abs=1e-9
        )
        assert (changing.drawn_ms, changing.stall_ms) == pytest.approx((steady.drawn_ms, steady.stall_ms))


@given(seed=SEEDS)
def test_effects_add_up(seed: int) -> None:
    """A single segment takes its sending time plus delay, jitter and stall, each from its own draw."""
    conditions = LinkConditions(30, 5, "normal", 8, correlation=0.5, loss=0.3, loss_burst=3, stall_ms=100)
    pipe, jitter, loss = Pipe(conditions, seed, 4, "up"), Jitter(f"{seed}/4/up"), Loss(f"{seed}/4/up")
    for n in range(50):
        late_ms = 30 + 5 * DISTRIBUTIONS["normal"](jitter.at(n, 0.5)) + stall_ms(loss.times(n, 0.3, 3), 100)
        due_s = pipe.due(n * 100.0, SEGMENT_BYTES)
        assert due_s == pytest.approx(n * 100.0 + 1448e-6 + late_ms / 1e3, abs=1e-9)


def test_chunks_behind_a_lost_segment_wait_for_it() -> None:
    """Chunks behind a lost segment come out with it, as in TCP; a chunk after that is not delayed."""
    pipe = Pipe(LinkConditions(delay_ms=10, loss=1, stall_ms=1), 0, 0, "up")
    stalled_s = 0.010 + 0.063  # lost six times: 1 + 2 + 4 + 8 + 16 + 32 ms
    assert pipe.due(0.0, 100) == pytest.approx(stalled_s)
    assert pipe.stall_ms == 63
    assert pipe.due(0.001, 100) == pytest.approx(stalled_s)
    assert pipe.due(1.0, 100) == pytest.approx(1.010)
    assert pipe.stall_ms == 0


def test_samples_replace_jitter_unscaled() -> None:
    """Measured delays are added to the delay unchanged; jitter_ms is not used."""
    samples = (3.0, 1.0, 7.0)
    pipe = Pipe(LinkConditions(10, 99, "samples", samples=samples), 1, 0, "up")
    late_ms = {round(1e3 * (pipe.due(float(n), SEGMENT_BYTES) - n), 6) for n in range(200)}
    assert late_ms == {11.0, 13.0, 17.0}


def test_truncation_counts_bytes_of_the_stream() -> None:
    """At most `truncate_bytes` bytes of a stream pass, also when the limit is set later; 0 is no limit."""
    pipe = Pipe(LinkConditions(truncate_bytes=5000), 0, 0, "up")
    assert pipe.left(9000) == 5000
    pipe.due(0.0, 4000)
    assert (pipe.left(500), pipe.left(9000)) == (500, 1000)
    pipe.conditions = LinkConditions(truncate_bytes=100)
    assert pipe.left(1) == 0
    pipe.conditions = LinkConditions()
    assert pipe.left(9000) == 9000


def test_a_slow_close_delays_only_the_end() -> None:
    """The bytes come without the extra delay, the end of the stream with it."""
    pipe = Pipe(LinkConditions(delay_ms=10, slow_close_ms=500), 0, 0, "up")
    assert pipe.due(0.0, 5000) == 0.010
    assert pipe.due(0.0, 0) == pytest.approx(0.510)


@given(bandwidth_mbps=st.floats(0.1, 10_000), sizes=CUTS)
def test_a_burst_is_one_bucket(bandwidth_mbps: float, sizes: list[int]) -> None:
    """A chunk is at most one bucket and ends with a segment; a bucket is one segment or 1 ms of bandwidth."""
    pipe = Pipe(LinkConditions(bandwidth_mbps=bandwidth_mbps), 0, 0, "up")
    assert pipe.bucket_bytes is not None
    assert pipe.bucket_bytes <= max(SEGMENT_BYTES, min(CHUNK_BYTES, BUCKET_S * bandwidth_mbps * 1e6 / 8))
    for size in sizes:
        while size:
            chunk = pipe.chunk_bytes(size)
            assert 0 < chunk <= pipe.bucket_bytes
            pipe.due(0.0, chunk)
            size -= chunk
            assert size == 0 or pipe.taken % SEGMENT_BYTES == 0


def test_segments_that_draw_travel_alone() -> None:
    """With jitter or loss a chunk is one segment, else up to eight; without any limit it is all bytes."""
    for effect in ({"jitter_ms": 1.0}, {"loss": 0.1}):
        assert Pipe(LinkConditions(**effect), 0, 0, "up").chunk_bytes(10**6) == SEGMENT_BYTES
    assert Pipe(LinkConditions(bandwidth_mbps=400), 0, 0, "up").chunk_bytes(10**6) == CHUNK_BYTES
    assert Pipe(LinkConditions(delay_ms=15), 0, 0, "up").chunk_bytes(10**6) == 10**6


def test_conditions_change_for_later_chunks() -> None:
    """New conditions apply to the next chunk, which still does not overtake the chunk before it."""
    pipe = Pipe(LinkConditions(delay_ms=100), 0, 0, "up")
    assert pipe.due(0.0, 10) == 0.1
    pipe.conditions = LinkConditions(delay_ms=1)
    assert pipe.due(0.0, 10) == 0.1
    assert pipe.due(0.5, 10) == 0.501


def test_the_end_of_a_stream_is_delayed_and_takes_no_draw() -> None:
    """The end comes out after the last byte, and does not use the draw of a segment."""
    pipe, other = (Pipe(LinkConditions(50, 5), 0, 0, "up") for _ in range(2))
    last_s = pipe.due(0.0, 10)
    assert pipe.due(0.0, 0) == last_s == other.due(0.0, 10)
    assert pipe.due(9.0, SEGMENT_BYTES) == other.due(9.0, SEGMENT_BYTES)
