"""Simulates sets of scenarios with this checkout and another one, and compares times over oracle.

    python -m benchmarks.against_simulated ../before --out out/against-simulated

`shipped`: the scenarios of `loadgen` that can be simulated, with their own seeds. `fresh`: the same with
other seeds. `unseen`: scenarios that nothing was tuned on. The command can be stopped and resumed; delete its
folder to start anew.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.against import AFTER, BEFORE, HERE
from benchmarks.measure import Table
from benchmarks.simulated_sets import (
    SETS,
    Checkout,
    Figures,
    ScenarioSet,
    by_scenario,
    scenario_sets,
    simulate,
    table,
)
from offboard.robot_client import policies

PAPER = "paper"
FAR = 0.03  # a difference in one scenario that is listed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against_simulated", description=__doc__)
    parser.add_argument("before", type=Path, metavar="CHECKOUT", help="the other checkout")
    parser.add_argument(
        "--out", type=Path, default=Path("out/against-simulated"), help="(default: %(default)s)"
    )
    add_flags(parser)
    flags = parser.parse_args()
    before, after = Checkout(flags.before.resolve()), Checkout(HERE)
    if not before.is_one():
        parser.error(f"{flags.before} is no checkout of Offboard")
    for name, scenarios in chosen_sets(parser, flags).items():
        out, strategies = flags.out.resolve() / name, [policies.DEFAULT, PAPER]
        new = simulate(after, scenarios, strategies, out / AFTER)
        old = simulate(before, scenarios, strategies, out / BEFORE)
        figures = {BEFORE: old[policies.DEFAULT], AFTER: new[policies.DEFAULT], PAPER: new[PAPER]}
        print(table(name, figures, BEFORE))
        print(far_apart(name, figures), flush=True)
        if old[PAPER] != new[PAPER]:
            print(far_apart(f"{name}, {PAPER} in both checkouts", {BEFORE: old[PAPER], AFTER: new[PAPER]}))
    return 0


def add_flags(parser: argparse.ArgumentParser, sets: Sequence[str] = SETS) -> None:
    """The flags that choose what is simulated; `sets` are the default."""
    known = ", ".join(SETS)
    parser.add_argument("--sets", default=",".join(sets), help=f"some of {known} (default: %(default)s)")
    parser.add_argument("--scenarios", help="some of their scenarios, by name (default: all)")
    parser.add_argument("--seeds", type=int, help="seeds of each scenario (default: as many as the set has)")


def chosen_sets(parser: argparse.ArgumentParser, flags: argparse.Namespace) -> dict[str, ScenarioSet]:
    """The sets that the flags choose, by name."""
    known = scenario_sets()
    scenarios = {path.stem for one in known.values() for path in one.scenarios}
    for name, allowed in [
        *((one, SETS) for one in flags.sets.split(",")),
        *((one, sorted(scenarios)) for one in (flags.scenarios or "").split(",") if one),
    ]:
        if name not in allowed:
            parser.error(f"{name!r} is not one of {', '.join(allowed)}")
    if flags.seeds is not None and flags.seeds < 1:
        parser.error(f"--seeds: {flags.seeds} is below 1")
    found = scenario_sets(flags.scenarios and flags.scenarios.split(","))
    return {
        name: found[name] if flags.seeds is None else replace(found[name], seeds=flags.seeds)
        for name in flags.sets.split(",")
        if found[name].scenarios
    }


def far_apart(title: str, figures: Mapping[str, Figures]) -> Table:
    """The scenarios in which before and after differ by more than FAR, the largest difference first."""
    means = {name: by_scenario(of) for name, of in figures.items()}
    apart = {name: means[AFTER][name] - means[BEFORE][name] for name in means[BEFORE]}
    rows = [
        [name, *(f"{of[name]:.3f}" for of in means.values()), f"{apart[name]:+.3f}"]
        for name in sorted(apart, key=lambda name: -abs(apart[name]))
        if abs(apart[name]) > FAR
    ]
    return Table(f"{title}: differences beyond {FAR}", ["scenario", *means, "difference"], rows)


if __name__ == "__main__":
    sys.exit(main())
