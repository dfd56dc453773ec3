"""The link model: delay, jitter, bandwidth and order, all on given times."""

import itertools
import math
import random
import statistics
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.jitter import DISTRIBUTIONS, Jitter
from offboard.loadgen.relay.link.link import BUCKET_S, CHUNK_BYTES, SEGMENT_BYTES, Link, LinkConditions, Pipe
from offboard.loadgen.relay.link.loss import Loss, stall_ms

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
    """A chunk comes out the delay after it arrived."""
    assert Pipe(LinkConditions(delay_ms=15), 0, 0, "up").due(100.0, 5000) == 100.015


@given(bandwidth_mbps=st.floats(0.1, 1000), sizes=CUTS)
def test_bandwidth_is_exact(bandwidth_mbps: float, sizes: list[int]) -> None:
    """Chunks sent at once come out when all bits up to their last have been serialised, then delayed."""
    pipe = Pipe(LinkConditions(delay_ms=10, bandwidth_mbps=bandwidth_mbps), 0, 0, "up")
    for size, total in zip(sizes, itertools.accumulate(sizes), strict=True):
        due_s = pipe.due(0.0, size)
        assert due_s == pytest.approx(0.010 + total * 8 / (bandwidth_mbps * 1e6), rel=1e-9)


def test_an_idle_link_saves_up_no_bandwidth() -> None:
    """A chunk after a pause takes its own serialisation time, no less."""
    pipe = Pipe(LinkConditions(bandwidth_mbps=8), 0, 0, "up")
    assert pipe.due(0.0, 1000) == pytest.approx(0.001)
    assert pipe.due(5.0, 1000) == pytest.approx(5.001)
    assert pipe.due(5.0, 1000) == pytest.approx(5.002)


@given(seed=SEEDS, distribution=st.sampled_from(list(DISTRIBUTIONS)), sizes=CUTS)
def test_how_bytes_are_cut_changes_no_draw(seed: int, distribution: str, sizes: list[int]) -> None:
    """The same bytes at the same time, cut in chunks or in segments, end at the same time."""
    conditions = LinkConditions(50, 5, distribution, 100)
    whole, cut = (Pipe(conditions, seed, 3, "down") for _ in range(2))
    assert [cut.due(1.0, size) for size in sizes][-1] == pytest.approx(whole.due(1.0, sum(sizes)), abs=1e-9)
    assert cut.due(9.0, SEGMENT_BYTES) == pytest.approx(whole.due(9.0, SEGMENT_BYTES), abs=1e-9)


@given(seed=SEEDS, sizes=CUTS)
def test_draws_do_not_depend_on_conditions_before(seed: int, sizes: list[int]) -> None:
    """A segment's draw is the same whatever the link was like for the segments before it."""
    calm, rough = (Pipe(LinkConditions(50, 5, name), seed, 0, "up") for name in ("constant", "lognormal"))
    calm.conditions = LinkConditions()
    for size in sizes:
        calm.due(0.0, size)
        rough.due(0.0, size)
    calm.conditions = rough.conditions = LinkConditions(50, 5, "normal")
    assert calm.due(1e6, SEGMENT_BYTES) == rough.due(1e6, SEGMENT_BYTES)


@given(seed=SEEDS, distribution=st.sampled_from(list(DISTRIBUTIONS)), sizes=CUTS, gap_s=st.floats(0, 0.01))
def test_order_is_kept(seed: int, distribution: str, sizes: list[int], gap_s: float) -> None:
    """No chunk comes out before the one before it, nor before it arrived."""
    pipe = Pipe(LinkConditions(5, 20, distribution), seed, 0, "up")
    arrived = [n * gap_s for n in range(len(sizes))]
    due = [pipe.due(arrived_s, size) for arrived_s, size in zip(arrived, sizes, strict=True)]
    assert due == sorted(due)
    assert all(due_s >= arrived_s for due_s, arrived_s in zip(due, arrived, strict=True))


def test_seed_connection_and_direction_each_matter() -> None:
    """Equal seed, connection and direction draw equally; a change of any one draws differently."""

    def draws(*origin: Any) -> tuple[float, ...]:
        pipe = Pipe(LinkConditions(50, 5), *origin)
        return tuple(pipe.due(float(n), SEGMENT_BYTES) for n in range(5))

    assert draws(1, 2, "up") == draws(1, 2, "up")
    assert len({draws(1, 2, "up"), draws(0, 2, "up"), draws(1, 1, "up"), draws(1, 2, "down")}) == 4


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_distributions_have_the_stated_mean_and_deviation(distribution: str) -> None:
    """50,000 far-apart segments: mean and standard deviation of the jitter are the distribution's own."""
    pipe = Pipe(LinkConditions(1000, 10, distribution), 1, 0, "up")
    jitter = [(pipe.due(n * 1e4, SEGMENT_BYTES) - n * 1e4 - 1.0) / 0.010 for n in range(50_000)]
    assert statistics.mean(jitter) == pytest.approx(MEAN[distribution], abs=0.03)
    assert statistics.pstdev(jitter) == pytest.approx(DEVIATION[distribution], rel=0.15, abs=1e-6)


def test_jitter_is_drawn_as_ever() -> None:
    """Segment n has number n of the generator seeded with seed, connection and direction."""
    generator = random.Random("9/2/down")
    draws = [1 - generator.random() for _ in range(100)]
    pipe = Pipe(LinkConditions(50, 5, "uniform"), 9, 2, "down")
    for n, draw in enumerate(draws):
        assert pipe.due(float(n), SEGMENT_BYTES) - n == pytest.approx((50 + 5 * (2 * draw - 1)) / 1e3)


@given(seed=SEEDS, sizes=CUTS, burst=st.sampled_from([1.0, 5.0]), correlation=st.sampled_from([0.0, 0.7]))
def test_all_effects_together_do_not_depend_on_cuts(
    seed: int, sizes: list[int], burst: float, correlation: float
) -> None:
    """With jitter, correlation, loss, bandwidth and a slow close, the same bytes end at the same time."""
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
def test_no_effect_before_changes_a_draw(seed: int, before: list[str], now: str) -> None:
    """Whichever effects were on for the segments before, a segment gets what it would have got anyway."""
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
    """A segment on its own is due after serialisation, delay, its jitter and its stall, each its own draw."""
    conditions = LinkConditions(30, 5, "normal", 8, correlation=0.5, loss=0.3, loss_burst=3, stall_ms=100)
    pipe, jitter, loss = Pipe(conditions, seed, 4, "up"), Jitter(f"{seed}/4/up"), Loss(f"{seed}/4/up")
    for n in range(50):
        late_ms = 30 + 5 * DISTRIBUTIONS["normal"](jitter.at(n, 0.5)) + stall_ms(loss.times(n, 0.3, 3), 100)
        due_s = pipe.due(n * 100.0, SEGMENT_BYTES)
        assert due_s == pytest.approx(n * 100.0 + 1448e-6 + late_ms / 1e3, abs=1e-9)


def test_what_follows_a_lost_segment_waits_for_it() -> None:
    """TCP keeps order: chunks behind a lost segment come out with it, one after that is free."""
    pipe = Pipe(LinkConditions(delay_ms=10, loss=1, stall_ms=1), 0, 0, "up")
    stalled_s = 0.010 + 0.063  # six times lost: 1 + 2 + 4 + 8 + 16 + 32 ms
    assert pipe.due(0.0, 100) == pytest.approx(stalled_s)
    assert pipe.stall_ms == 63
    assert pipe.due(0.001, 100) == pytest.approx(stalled_s)
    assert pipe.due(1.0, 100) == pytest.approx(1.010)
    assert pipe.stall_ms == 0


def test_samples_replace_jitter_unscaled() -> None:
    """Measured delays are added to the delay as they are; jitter_ms plays no part."""
    samples = (3.0, 1.0, 7.0)
    pipe = Pipe(LinkConditions(10, 99, "samples", samples=samples), 1, 0, "up")
    late_ms = {round(1e3 * (pipe.due(float(n), SEGMENT_BYTES) - n), 6) for n in range(200)}
    assert late_ms == {11.0, 13.0, 17.0}


def test_truncation_counts_bytes_of_the_stream() -> None:
    """No more than so many bytes are let through, whenever the limit is set; 0 is no limit."""
    pipe = Pipe(LinkConditions(truncate_bytes=5000), 0, 0, "up")
    assert pipe.left(9000) == 5000
    pipe.due(0.0, 4000)
    assert (pipe.left(500), pipe.left(9000)) == (500, 1000)
    pipe.conditions = LinkConditions(truncate_bytes=100)
    assert pipe.left(1) == 0
    pipe.conditions = LinkConditions()
    assert pipe.left(9000) == 9000


def test_a_slow_close_delays_the_end_alone() -> None:
    """Bytes come as ever, the end of the stream so much later."""
    pipe = Pipe(LinkConditions(delay_ms=10, slow_close_ms=500), 0, 0, "up")
    assert pipe.due(0.0, 5000) == 0.010
    assert pipe.due(0.0, 0) == pytest.approx(0.510)


@given(bandwidth_mbps=st.floats(0.1, 10_000), sizes=CUTS)
def test_a_burst_is_one_bucket(bandwidth_mbps: float, sizes: list[int]) -> None:
    """Chunks end with a segment, hold a bucket at most, and a bucket is one segment or 1 ms of bandwidth."""
    pipe = Pipe(LinkConditions(bandwidth_mbps=bandwidth_mbps), 0, 0, "up")
    assert pipe.bucket_bytes <= max(SEGMENT_BYTES, min(CHUNK_BYTES, BUCKET_S * bandwidth_mbps * 1e6 / 8))
    for size in sizes:
        while size:
            chunk = pipe.chunk_bytes(size)
            assert 0 < chunk <= pipe.bucket_bytes
            pipe.due(0.0, chunk)
            size -= chunk
            assert size == 0 or pipe.taken % SEGMENT_BYTES == 0


def test_segments_that_draw_travel_alone() -> None:
    """With jitter or loss a chunk is within one segment; else up to eight go together, all where even the
    bandwidth has no limit."""
    for effect in ({"jitter_ms": 1.0}, {"loss": 0.1}):
        assert Pipe(LinkConditions(**effect), 0, 0, "up").chunk_bytes(10**6) == SEGMENT_BYTES
    assert Pipe(LinkConditions(bandwidth_mbps=400), 0, 0, "up").chunk_bytes(10**6) == CHUNK_BYTES
    assert Pipe(LinkConditions(delay_ms=15), 0, 0, "up").chunk_bytes(10**6) == 10**6


def test_conditions_change_for_later_chunks() -> None:
    """New conditions hold for the next chunk; the one under way is not overtaken."""
    pipe = Pipe(LinkConditions(delay_ms=100), 0, 0, "up")
    assert pipe.due(0.0, 10) == 0.1
    pipe.conditions = LinkConditions(delay_ms=1)
    assert pipe.due(0.0, 10) == 0.1
    assert pipe.due(0.5, 10) == 0.501


def test_the_end_of_a_stream_is_delayed_and_draws_nothing() -> None:
    """A chunk of no bytes comes out after what was before it, and takes no segment's draw."""
    pipe, other = (Pipe(LinkConditions(50, 5), 0, 0, "up") for _ in range(2))
    last_s = pipe.due(0.0, 10)
    assert pipe.due(0.0, 0) == last_s == other.due(0.0, 10)
    assert pipe.due(9.0, SEGMENT_BYTES) == other.due(9.0, SEGMENT_BYTES)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"delay_ms": -1}, "delay_ms: -1 is not a number from 0 to 60000"),
        ({"delay_ms": math.nan}, "delay_ms: nan is not a number from 0 to 60000"),
        ({"jitter_ms": "5"}, "jitter_ms: '5' is not a number from 0 to 60000"),
        ({"bandwidth_mbps": math.inf}, "bandwidth_mbps: inf is not a number from 0 to 100000"),
        ({"bandwidth_mbps": True}, "bandwidth_mbps: True is not a number from 0 to 100000"),
        (
            {"distribution": "gamma"},
            "distribution: 'gamma' is not one of constant, uniform, normal, pareto, lognormal, samples",
        ),
        ({"outage": 1}, "outage: 1 is neither true nor false"),
        ({"hang": 0}, "hang: 0 is neither true nor false"),
        ({"correlation": 1.5}, "correlation: 1.5 is not a number from 0 to 1"),
        ({"loss": 2}, "loss: 2 is not a number from 0 to 1"),
        ({"loss_burst": 0.5}, "loss_burst: 0.5 is not a number from 1 to 10000"),
        ({"stall_ms": -1}, "stall_ms: -1 is not a number from 0 to 60000"),
        ({"reset_after_ms": None}, "reset_after_ms: None is not a number from 0 to 8.64e+07"),
        ({"truncate_bytes": 1.5}, "truncate_bytes: 1.5 is not a whole number"),
        ({"slow_close_ms": "1"}, "slow_close_ms: '1' is not a number from 0 to 60000"),
        ({"samples": "file"}, "samples: 'file' is not a list of delays in ms"),
        ({"samples": [1, -2]}, "samples: -2 is not a number from 0 to 60000"),
        ({"distribution": "samples"}, "samples: none are given, distribution 'samples' draws from them"),
    ],
)
def test_a_bad_condition_is_named(values: dict[str, Any], message: str) -> None:
    """A condition that cannot be is refused, with field, value and what is allowed."""
    with pytest.raises(ConfigError) as caught:
        LinkConditions(**values)
    assert str(caught.value) == message


def test_a_link_changes_in_both_directions_or_one() -> None:
    """Plain names change both directions, `up` and `down` one, which wins; the rest stays."""
    link = Link().changed({"delay_ms": 5, "down": {"delay_ms": 7, "outage": True}})
    assert link == Link(up=LinkConditions(delay_ms=5), down=LinkConditions(delay_ms=7, outage=True))


def test_an_unknown_condition_is_named() -> None:
    """A name that no link has is refused, with those it has."""
    with pytest.raises(ConfigError, match="delay: unknown condition; known: delay_ms, jitter_ms"):
        Link().changed({"delay": 5})
