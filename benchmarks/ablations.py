"""Leaves out one mechanism of the default at a time, and shows what it costs.

    python -m benchmarks.ablations --seeds 4                                     # in simulation
    python -m benchmarks.ablations --cases apriltags-busy,registration-outage    # real runs

The classes of `left_out` are the predictors without a mechanism. The cases of real runs are those of
`against`. The command can be stopped and resumed; delete its folder to start anew.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.against import CASES, HERE, Played, play, read
from benchmarks.against import table as table_of_runs
from benchmarks.against_simulated import add_flags, chosen_sets
from benchmarks.measure import Table
from benchmarks.simulated_sets import Checkout, Figures, ScenarioSet, mean, simulate, table
from offboard.robot_client import policies

NOTHING = "nothing"
LITTLE = 0.003  # a mechanism that costs less in the mean of every set is listed


@dataclass(frozen=True, slots=True)
class LeftOut:
    """The default without a mechanism: a policy, a predictor (None: that of the policy), and heartbeats."""

    policy: str = policies.DEFAULT
    predictor: str | None = None
    heartbeats: bool = True

    @property
    def strategy(self) -> str:
        return self.policy if self.predictor is None else f"{self.policy}@{self.predictor}"


def _predictor(name: str) -> LeftOut:
    return LeftOut(predictor=f"benchmarks.left_out.{name}")


LEFT_OUT: dict[str, LeftOut] = {
    NOTHING: LeftOut(),
    "hedge": LeftOut("probe:greedy"),
    "probe": LeftOut("hedge:greedy"),
    "heartbeats": LeftOut(heartbeats=False),
    "round trip of heartbeats": _predictor("RoundTrip"),
    "work": _predictor("Work"),
    "all parts: total seconds": _predictor("AllParts"),
    "network apart from run": _predictor("NetworkLine"),
    "bytes": _predictor("Payload"),
    "queue": _predictor("Queue"),
    "capacity": _predictor("Capacity"),
    "load": _predictor("Load"),
    "begin_as": _predictor("LoadedShape"),
    "outlier rules": _predictor("Outliers"),
    "tail": _predictor("Tail"),
    "change": _predictor("Change"),
    "change to slower": _predictor("BadNews"),
    "change to faster at once": _predictor("GoodNews"),
    "at most doubles": _predictor("Doubling"),
    "bound": _predictor("Bound"),
    "late runs": _predictor("Late"),
    "PACE": _predictor("Pace"),
    "first slope": _predictor("FirstSlope"),
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablations", description=__doc__)
    parser.add_argument("--left-out", default=",".join(LEFT_OUT), help="some of %(default)s")
    parser.add_argument("--cases", help=f"play these instead of simulating: some of {', '.join(CASES)}")
    parser.add_argument("--first-seed", type=int, default=1, help="of the cases (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/ablations"), help="(default: %(default)s)")
    add_flags(parser)
    flags = parser.parse_args()
    names = list(dict.fromkeys([NOTHING, *flags.left_out.split(",")]))
    cases = flags.cases.split(",") if flags.cases else []
    for name, known in [*((one, LEFT_OUT) for one in names), *((one, CASES) for one in cases)]:
        if name not in known:
            parser.error(f"{name!r} is not one of {', '.join(known)}")
    if cases:
        seeds = range(flags.first_seed, flags.first_seed + (flags.seeds or 1))
        for case in cases:
            print(play_all(case, names, seeds, flags.out.resolve() / case), flush=True)
        return 0
    found = {}
    for name, scenarios in chosen_sets(parser, flags).items():
        found[name] = simulate_all(scenarios, names, flags.out.resolve() / name)
        print(table(f"{name}, left out", found[name], NOTHING), flush=True)
    print(f"Cost at most {LITTLE} in the mean of every set: {', '.join(cheap(found)) or 'none'}")
    return 0


def simulate_all(scenarios: ScenarioSet, names: Sequence[str], out: Path) -> dict[str, Figures]:
    """Time over oracle without each mechanism."""
    found = {}
    for heartbeats, folder in ((True, "with-heartbeats"), (False, "without-heartbeats")):
        some = [name for name in names if LEFT_OUT[name].heartbeats is heartbeats]
        if some:
            strategies = [LEFT_OUT[name].strategy for name in some]
            flags = [] if heartbeats else ["--no-heartbeats"]
            played = simulate(Checkout(HERE), scenarios, strategies, out / folder, flags=flags)
            found |= dict(zip(some, played.values(), strict=True))
    return {name: found[name] for name in names}


def play_all(case: str, names: Sequence[str], seeds: Sequence[int], out: Path) -> Table:
    """Real runs of one case without each mechanism, in turns."""
    out.mkdir(parents=True, exist_ok=True)
    files = {
        heartbeats: out / f"{case}{'' if heartbeats else '-silent'}.toml" for heartbeats in (True, False)
    }
    for heartbeats, file in files.items():
        text = CASES[case].text()
        file.write_text(text if heartbeats else text.replace("[robot]\n", "[robot]\nheartbeats = false\n"))
    runs: dict[str, list[Played]] = {name: [] for name in names}
    for n, seed in enumerate(seeds):
        turn = n % len(names)
        for name in [*names[turn:], *names[:turn]]:
            one, folder = LEFT_OUT[name], out / f"{seed}-{name.replace(' ', '-')}"
            play(
                HERE,
                files[one.heartbeats],
                folder,
                policy=one.policy,
                predictor=one.predictor,
                seed=seed,
                tasks=CASES[case].tasks,
            )
            runs[name].append(read(folder))
    return table_of_runs(case, runs, NOTHING)


def cheap(found: Mapping[str, Mapping[str, Figures]]) -> list[str]:
    """The mechanisms that cost at most LITTLE in the mean of every set."""
    names = list(next(iter(found.values())))
    return [
        name
        for name in names
        if name != NOTHING and all(mean(of[name]) - mean(of[NOTHING]) <= LITTLE for of in found.values())
    ]


if __name__ == "__main__":
    sys.exit(main())
