"""A comparison removes differences in machine speed, but not differences between policies."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from offboard.loadgen.compare.compare_settings import CompareConfig
from offboard.loadgen.compare.comparison_line import Line
from offboard.loadgen.compare.comparison_table import comparison_table
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

SEEDS = 8
TASKS = 200
LINK_S = 0.03
CONFIG = CompareConfig(policies=("paper", "onboard", "cloud"), seeds=SEEDS)


def runs(slowness: Sequence[float], *, extra_s: float = 0.0, chosen: str = "cloud") -> list[Outcome]:
    """Runs of the same tasks on the same link; in each run the machine is `slowness` times slower."""
    work_s = np.random.default_rng(1).uniform(0.005, 0.025, (SEEDS, TASKS))
    found = []
    for seed, slow in enumerate(slowness):
        noise = np.random.default_rng(seed).normal(1, 0.05, TASKS)
        server_s = work_s[seed] * slow * noise
        tasks = [
            Answered(
                i=i,
                robot="robot",
                due_s=i,
                ended_s=i + LINK_S + extra_s + server_s[i],
                error=None,
                answer=None,
                chosen=chosen,
                both=False,
                sites=(chosen,),
                server_s=server_s[i] if chosen == "cloud" else None,
            )
            for i in range(TASKS)
        ]
        found.append(Outcome(asked={"robot": TASKS}, answered=tasks))
    return found


def lines(constant: list[Outcome], other: list[Outcome]) -> dict[str, Line]:
    """The lines of `paper`, by their bound; `constant` are the runs of `cloud`, the better constant."""
    slowest = runs([1.0] * SEEDS, extra_s=1.0, chosen="onboard")
    onboard = [replace(run, answered=run.answered[:1]) for run in slowest]
    played = {"paper": other, "onboard": onboard, "cloud": constant}
    of_all = comparison_table(read_scenario(find_scenario("calm")), CONFIG, played).lines
    return {line.bound: line for line in of_all if line.policy == "paper"}


def of(line: Line, name: str) -> float:
    value = getattr(line, name)
    assert isinstance(value, float)
    return value


def slow(seed: int) -> Any:
    return np.random.default_rng(seed).normal(1, 0.15, SEEDS)


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_slower_machine_does_not_make_the_policy_look_slower(seed: int) -> None:
    """If only the machine differed, the corrected ratio is nearer to 1 and its interval is narrower."""
    found = lines(runs(slow(1)), runs(1.15 * slow(seed)))
    ratio, alone = of(found[""], "over_constant"), of(found[""], "at_one_speed")
    assert of(found[""], "server_over_constant") > 1.03
    assert abs(alone - 1) < 0.5 * abs(ratio - 1)
    low, high = found["2.5 %"], found["97.5 %"]
    width = {name: of(high, name) - of(low, name) for name in ("over_constant", "at_one_speed")}
    assert width["at_one_speed"] < width["over_constant"]


def test_a_slower_policy_still_looks_slower() -> None:
    """Time that the policy adds to each task stays in the corrected ratio, whatever the machine did."""
    plain = lines(runs(slow(1)), runs(slow(1), extra_s=0.0045))[""]
    assert plain.at_one_speed == pytest.approx(1.1, abs=0.02)
    found = lines(runs(slow(1)), runs(1.2 * slow(2), extra_s=0.0045))[""]
    assert found.at_one_speed == pytest.approx(1.1, abs=0.02)


def test_without_common_cloud_tasks_the_machine_speed_is_unknown() -> None:
    """If no task ran in the cloud under both policies, there is a plain ratio but no corrected one."""
    found = lines(runs(slow(1)), runs(slow(2), chosen="onboard"))[""]
    assert found.over_constant is not None
    assert (found.server_over_constant, found.at_one_speed) == (None, None)
