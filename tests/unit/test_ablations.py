"""What leaving out a mechanism costs: which figures are compared, and when a mechanism stays."""

import math
from pathlib import Path

import pytest

from benchmarks.ablations import NOTHING, Cost, cost_of, logs, over_recordings, stays, table

WHOLE = {(unit, str(seed)): 1.0 + 0.1 * seed for unit in ("calm", "outage") for seed in range(12)}


def costs(outage: float) -> dict[tuple[str, str], float]:
    """The times without a mechanism that costs something in one scenario."""
    return {pair: time * (outage if pair[0] == "outage" else 1.0) for pair, time in WHOLE.items()}


def test_the_same_seeds_are_compared() -> None:
    """What makes every seed of a scenario 4 % slower costs 4 % there, and nothing elsewhere."""
    units = logs(costs(1.04), WHOLE)
    assert units["calm"] == pytest.approx([0.0] * 12)
    found = cost_of(units["outage"])
    assert (found.mean, found.low, found.high) == pytest.approx((0.04, 0.04, 0.04))


def test_of_few_scenarios_there_is_no_interval() -> None:
    """Then the mean of a set decides nothing."""
    found = cost_of([0.1, 0.2])
    assert math.isnan(found.low)
    assert str(found) == "+16.2"
    assert not stays([found], [])


@pytest.mark.parametrize(
    ("mean", "single", "said"),
    [
        (Cost(0.02, 0.01, 0.03), Cost(0.0, 0.0, 0.0), True),
        (Cost(0.02, -0.01, 0.03), Cost(0.0, 0.0, 0.0), False),  # it may be chance
        (Cost(0.005, 0.004, 0.006), Cost(0.02, 0.01, 0.03), False),  # certain, and small
        (Cost(0.0, -0.1, 0.1), Cost(0.04, 0.01, 0.06), True),
        (Cost(-0.02, -0.03, -0.01), Cost(0.04, -0.01, 0.06), False),
    ],
)
def test_a_mechanism_stays_if_it_costs_enough_for_certain(mean: Cost, single: Cost, said: bool) -> None:
    """More than 1 % in the mean of a set, or 3 % in one scenario, with an interval above 0."""
    assert stays([mean], [single]) is said


def test_a_line_says_largest_loss_and_gain() -> None:
    """One line for each mechanism, with the scenario where it costs most and the one where it gains most."""
    rows = table({"fresh": {NOTHING: WHOLE, "hedge": costs(1.04), "tail": costs(0.98)}}).rows
    assert rows[0] == ["hedge", "+2.0", "outage +4.0 [+4.0, +4.0]", "calm +0.0 [+0.0, +0.0]", "yes"]
    assert rows[1][2:] == ["calm +0.0 [+0.0, +0.0]", "outage -2.0 [-2.0, -2.0]", "**no**"]


def test_every_second_recording_judges(tmp_path: Path) -> None:
    """Of four recordings two are played, with each workload; a recording is compared with itself."""
    folder = tmp_path / "links" / "town"
    folder.mkdir(parents=True)
    for n in range(4):
        (folder / f"{n}.csv").write_text("t_s,rtt_ms\n0,30\n1,40\n")
    found = over_recordings(folder.parent, [NOTHING], tmp_path / "out", tasks=3)[NOTHING]
    assert {unit for unit, _ in found} == {"town"}
    assert {key.rpartition("/")[2] for _, key in found} == {"1", "3"}
    assert len(found) == 6
    assert all(time > 0 for time in found.values())
