"""When tasks are due and which sizes they have, from specs and a seed."""

from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.robot.workload import (
    BURSTS,
    CONSTANT,
    POISSON,
    SIZE_MAX,
    due_instants,
    parse_sizes,
    sizes,
)

SEEDS = (1, 2, 3)


def drawn(count: int, *specs: str, seed: int = 1) -> list[float]:
    return list(islice(sizes(parse_sizes(specs), seed), count))


@pytest.mark.parametrize("seed", SEEDS)
def test_poisson_gaps_are_exponential(seed: int) -> None:
    """10,000 gaps match the rate within 4 standard errors, pass a KS test, and are not correlated."""
    rate, count = 20.0, 10_000
    instants = list(islice(due_instants(POISSON, rate, 1, seed), count + 1))
    gaps = np.diff(instants)
    assert instants[0] == 0
    error = abs(gaps.mean() * rate - 1)
    print(f"mean gap {gaps.mean():.5f} s, wanted {1 / rate} +- {4 / rate / count**0.5:.5f}")
    assert error < 4 / count**0.5
    assert stats.kstest(gaps, stats.expon(scale=1 / rate).cdf).pvalue > 0.01
    assert abs(np.corrcoef(gaps[1:], gaps[:-1])[0, 1]) < 4 / count**0.5


def test_constant_arrivals_do_not_drift() -> None:
    """Task n is due at exactly n / rate."""
    instants = list(islice(due_instants(CONSTANT, 30.0, 1, 1), 10_001))
    assert instants == [n / 30.0 for n in range(10_001)]


def test_bursts_keep_the_rate() -> None:
    """At 8 tasks per second, four tasks are due at once every 0.5 s, the first four at the start."""
    instants = list(islice(due_instants(BURSTS, 8.0, 4, 1), 12))
    assert instants == [0.0] * 4 + [0.5] * 4 + [1.0] * 4


@pytest.mark.parametrize("arrivals", [CONSTANT, POISSON, BURSTS])
def test_the_seed_decides_the_arrivals(arrivals: str) -> None:
    """The same seed gives the same instants; only Poisson arrivals depend on the seed."""
    first, again, other = (list(islice(due_instants(arrivals, 5.0, 3, seed), 50)) for seed in (1, 1, 2))
    assert first == again
    assert (first != other) == (arrivals == POISSON)


def test_sizes_follow_their_law() -> None:
    """Constant, uniform and lognormal sizes pass KS tests of their spec; MEDIAN is the median."""
    assert drawn(3, "constant:2.5") == [2.5] * 3
    uniform = drawn(5000, "uniform:10:30")
    assert stats.kstest(uniform, stats.uniform(10, 20).cdf).pvalue > 0.01
    lognormal = drawn(5000, "lognormal:7:0.5")
    assert stats.kstest(lognormal, stats.lognorm(s=0.5, scale=7).cdf).pvalue > 0.01
    assert max(drawn(2000, "lognormal:1e15:10")) == SIZE_MAX


@pytest.mark.parametrize("spec", ["uniform:1:9", "lognormal:3:1"])
def test_the_seed_decides_the_sizes(spec: str) -> None:
    """One seed always gives the same sizes, seeds differ, and sizes are not correlated with arrivals."""
    assert drawn(40, spec) == drawn(40, spec)
    assert drawn(40, spec) != drawn(40, spec, seed=2)
    gaps = [b - a for a, b in pairwise(islice(due_instants(POISSON, 1.0, 1, 1), 41))]
    assert abs(np.corrcoef(drawn(40, spec), gaps)[0, 1]) < 0.6


def test_a_phase_starts_at_its_task() -> None:
    """K=SPEC changes the sizes from task K on, in any order of the specs, and leaves other phases alone."""
    found = drawn(9, "7=constant:9", "uniform:1:2", "3=constant:5")
    assert found[3:] == [5, 5, 5, 5, 9, 9]
    assert all(1 <= size <= 2 for size in found[:3])
    assert drawn(5, "uniform:1:2", "3=uniform:3:4")[3:] == drawn(5, "constant:1", "3=uniform:3:4")[3:]
    assert drawn(2, "0=constant:4") == [4, 4]


def test_a_csv_file_is_read_in_order_and_repeated(tmp_path: Path) -> None:
    """Each phase reads the size column from the top, and starts again at the end of the file."""
    file = tmp_path / "sizes.csv"
    file.write_text("site,size\na,3\nb,1.5\nc,2\n")
    assert drawn(7, str(file)) == [3, 1.5, 2, 3, 1.5, 2, 3]
    assert drawn(7, "constant:0", f"2={file}") == [0, 0, 3, 1.5, 2, 3, 1.5]


@pytest.mark.parametrize(
    ("specs", "message"),
    [
        (["constant"], r"'constant' is not constant:X, uniform:LOW:HIGH"),
        (["constant:x"], r"'constant:x' is not constant:X"),
        (["constant:-1"], r"with numbers from 0 to 1e\+15"),
        (["constant:nan"], r"with numbers from 0 to 1e\+15"),
        (["uniform:1"], r"'uniform:1' is not constant:X"),
        (["uniform:1:2:3"], r"'uniform:1:2:3' is not"),
        (["uniform:3:2"], r"'uniform:3:2': LOW 3 is above HIGH 2"),
        (["lognormal:0:1"], r"'lognormal:0:1': MEDIAN is above 0 and SIGMA at most 10"),
        (["lognormal:1:11"], r"SIGMA at most 10"),
        (["5=constant:1"], r"5=constant:1: no spec holds from task 0 on"),
        (["constant:1", "uniform:1:2"], r"more than one spec holds from task 0 on"),
        (["constant:1", "4=constant:1", "4=constant:2"], r"more than one spec holds from task 4 on"),
    ],
)
def test_a_wrong_spec_is_named(specs: list[str], message: str) -> None:
    """The ConfigError names --sizes, the spec and what is allowed."""
    with pytest.raises(ConfigError, match=rf"^--sizes: .*{message}"):
        parse_sizes(specs)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"\.csv' is not constant:X, .* or a CSV file with a size column"),
        ("", r":1: there is no column 'size'"),
        ("d\n1\n", r":1: there is no column 'size'"),
        ("size\n", r"there is no row after the header"),
        ("size\n1\ntwo\n", r":3: size: 'two' is not a number from 0 to 1e\+15"),
        ("a,size\n1\n", r":2: size: None is not a number"),
        ("size\n-1\n", r":2: size: '-1' is not a number"),
    ],
)
def test_a_wrong_csv_file_is_named_with_its_line(tmp_path: Path, text: str | None, message: str) -> None:
    """The error is raised before the first size is drawn."""
    file = tmp_path / "sizes.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(DataError, match=rf"^--sizes: .*{message}"):
        sizes(parse_sizes(["constant:1", f"9={file}"]), 1)
