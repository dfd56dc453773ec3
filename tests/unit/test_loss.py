"""Loss: how many segments are lost, in which bursts, and how often a retransmission is lost."""

import itertools
import math

import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from offboard.loadgen.relay.link.draws import LOSSES_MAX, Loss, stall_ms

COUNT = 100_000
SHARE = 0.02
SEEDS = st.integers(0, 2**32)
RATES = st.sampled_from([(0.02, 1.0), (0.3, 1.0), (0.1, 20.0), (0.5, 3.0), (1.0, 1.0)])


def lost(origin: str, loss: float, burst: float, count: int = COUNT) -> list[bool]:
    state = Loss(origin)
    return [state.times(n, loss, burst) > 0 for n in range(count)]


def lengths(lost: list[bool]) -> list[int]:
    return [len(list(run)) for bad, run in itertools.groupby(lost) if bad]


def test_independent_loss_is_binomial() -> None:
    """At 2 % loss, the number of lost segments lies within its 99.9 % binomial interval."""
    count = sum(lost("1/1/up", SHARE, 1))
    low, high = scipy.stats.binom.interval(0.999, COUNT, SHARE)
    print(f"{count} lost, {low:.0f} to {high:.0f} expected")
    assert low <= count <= high


def test_independent_loss_has_no_memory() -> None:
    """A segment after a lost one is lost as often as any other, within the 99.9 % binomial interval."""
    found = lost("2/1/up", 0.2, 1)
    after = [now for before, now in itertools.pairwise(found) if before]
    low, high = scipy.stats.binom.interval(0.999, len(after), 0.2)
    print(f"{sum(after)} of {len(after)}, {low:.0f} to {high:.0f} expected")
    assert low <= sum(after) <= high


@pytest.mark.parametrize(("share", "burst"), [(SHARE, 2.0), (SHARE, 8.0), (0.3, 4.0)])
def test_bursts_have_the_stated_share_and_mean_length(share: float, burst: float) -> None:
    """Share and mean burst length lie within four standard errors of the values of Gilbert's model."""
    found = lost("3/1/up", share, burst)
    runs = lengths(found)
    ends, begins = 1 / burst, share / burst / (1 - share)
    memory = 1 - ends - begins  # correlation of neighbours; it widens the interval of the share
    spread = math.sqrt(share * (1 - share) / COUNT * (1 + memory) / (1 - memory))
    print(f"share {sum(found) / COUNT:.4f}, mean burst {sum(runs) / len(runs):.3f} of {len(runs)}")
    assert sum(found) / COUNT == pytest.approx(share, abs=4 * spread)
    geometric = math.sqrt(1 - ends) * burst
    assert sum(runs) / len(runs) == pytest.approx(burst, abs=4 * geometric / math.sqrt(len(runs)))


def test_a_retransmission_is_lost_with_the_same_share() -> None:
    """The share `loss` of lost segments is lost again; no segment is lost more often than the bound."""
    state = Loss("4/1/up")
    times = [found for n in range(COUNT) if (found := state.times(n, 0.3, 1))]
    again = sum(found > 1 for found in times)
    low, high = scipy.stats.binom.interval(0.999, len(times), 0.3)
    print(f"{again} of {len(times)}, {low:.0f} to {high:.0f} expected")
    assert low <= again <= high
    assert max(times) == LOSSES_MAX
    assert {Loss("5/1/up").times(n, 1.0, 1) for n in range(100)} == {LOSSES_MAX}


def test_the_stall_doubles() -> None:
    """The timer starts at 200 ms and doubles, so the stalls are 200, 600, 1400 ms, and so on."""
    assert [stall_ms(times, 200.0) for times in range(4)] == [0, 200, 600, 1400]


def test_without_loss_nothing_is_lost() -> None:
    """At a loss of 0 no segment is lost, whatever the burst length."""
    assert not any(lost("6/1/up", 0.0, 5, 1000))


@given(seed=SEEDS, asked=st.lists(st.tuples(st.integers(0, 3000), RATES)), rates=RATES)
def test_a_loss_belongs_to_its_segment(
    seed: int, asked: list[tuple[int, tuple[float, float]]], rates: tuple[float, float]
) -> None:
    """Whether a segment is lost does not depend on earlier rates."""
    used, fresh = Loss(f"{seed}/1/up"), Loss(f"{seed}/1/up")
    for number, (loss, burst) in asked:
        used.times(number, loss, burst)
    whole = [fresh.times(n, *rates) for n in range(1500)]
    assert [used.times(n, *rates) for n in range(1400, 1500)] == whole[1400:]
