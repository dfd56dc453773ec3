"""Claim 2: when rows in sequence say more about the next row than other rows."""

import numpy as np
import pytest

from offboard.loadgen.claims.claim import ClaimsConfig
from offboard.loadgen.claims.correlation_claims import IN_SEQUENCE, _sampled, sample_order
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.table_settings import FULL, TableConfig
from offboard.loadgen.table.table_two import Evaluation

COUNT = 400
CONFIG = ClaimsConfig(predictors=("least-squares",), seed=3)


def rows_of(*, stretch: int) -> Rows:
    """The load of both sites changes after each `stretch` rows; with 1, no row tells of the next one."""
    random = np.random.default_rng(8)
    size = random.uniform(0, 5, COUNT)
    onboard, cloud = (random.uniform(0.5, 2, COUNT // stretch).repeat(stretch) for _ in range(2))
    noise = random.normal(1, 0.02, (2, COUNT))
    return Rows(
        size, onboard_s=onboard * (0.1 + size) * noise[0], cloud_s=cloud * (1 + 0.5 * size) * noise[1]
    )


def test_neighbours_that_share_a_load_favour_sequential_samples() -> None:
    """Both correlations and the accuracy are higher, by more than their intervals."""
    found = list(sample_order(rows_of(stretch=80), CONFIG, length=20))
    assert [one.claim for one in found] == [
        f"sequential - {other}: {figure}"
        for other in ("shuffled", "random")
        for figure in ("r cloud", "r onboard", "accuracy")
    ]
    assert {(one.number, one.agrees) for one in found} == {(IN_SEQUENCE, "yes")}


def test_independent_rows_favour_none() -> None:
    """If each row has its own load, no sample is better, and no line agrees."""
    found = list(sample_order(rows_of(stretch=1), CONFIG, length=20))
    assert {one.agrees for one in found} == {"unclear"}


def test_sequential_samples_predict_as_loadgen_table_does() -> None:
    """The accuracy is that of line N of the table with feedback full."""
    rows = rows_of(stretch=80)
    table = Evaluation(rows, TableConfig()).predictions("least-squares", "20", FULL)
    assert table is not None
    sampled = _sampled(
        rows, 20, lambda at, _: at[:, np.newaxis] - np.arange(20, 0, -1), np.random.default_rng(0)
    )
    assert sampled.right.tolist() == table.right.tolist()


def test_samples_never_hold_the_row_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a shuffled table nor random samples show a row its own time, and no row is drawn twice."""
    from offboard.loadgen.claims import correlation_claims as module

    at, random = np.arange(20, 60), np.random.default_rng(0)
    monkeypatch.setattr(module, "DRAWS", 1)
    for name in ("shuffled", "random"):
        picks = module._other(name, 60, 20, random)(at, random)
        assert picks.shape == (40, 20)
        assert picks.min() >= 0
        assert picks.max() < 60
        assert not (picks == at[:, np.newaxis]).any()
        assert all(len(set(row)) == 20 for row in picks.tolist())


def test_too_few_rows_are_said() -> None:
    """A dataset that is no longer than the sample gets a line that says so."""
    rows = rows_of(stretch=80)
    short = Rows(rows.size[:20], rows.onboard_s[:20], rows.cloud_s[:20])
    (line,) = sample_order(short, CONFIG, length=20)
    assert (line.ours, line.note) == (None, "not enough rows")
