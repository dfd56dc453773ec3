"""Simulates what peers claim on the same shapes of test: several servers, and two links of one robot.

    python -m benchmarks.claims_of_others FOLDER_OF_5G_RECORDINGS [--seeds 3]

The rules of peers are in `loadgen/rivals/peer_policies.py`. Tasks before FROM_TASK do not count: most of them
run on all sites. docs/claims_of_others.md says what each system claims, and against what.
"""

import argparse
import csv
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.measure import Requirement, Table
from offboard.common.command_line import run_command
from offboard.common.errors import ConfigError
from offboard.loadgen.compare.recordings import RecordedLink, find_recordings
from offboard.loadgen.compare.runs import read_scenarios
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.scenario import CloudPart, Scenario
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.loadgen.table.table_two_figures import quantile
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PROG = "python -m benchmarks.claims_of_others"
HERE = Path(__file__).parent
PEERS = "offboard.loadgen.rivals.peer_policies"
ONE, OTHER, REPLICATE, OFFBOARD = "one server", "the other link", "all servers at once", "Offboard"
STRATEGIES: Mapping[str, str] = {
    ONE: CLOUD,
    "always onboard": ONBOARD,
    "the published rule": "paper",
    "hedge at P90 (as hedge-python)": f"{PEERS}.HedgeAtP90",
    "two servers at once": f"{PEERS}.TwoServers",
    REPLICATE: f"{PEERS}.Replicate",
    OFFBOARD: "default",
}
KINDS = ("plans", "frames", "images")
FROM_TASK = 60  # the window of the published rule is full after 50 tasks
LINK_TASKS = 300
SILENCE_MS = 1000.0
RESAMPLES = 2000
BETTER_MIN, BEHIND_MAX, RUNS_MAX = 5.5, 1.10, 1.3  # FogROS2-FT's shape
LINKS_BETTER_MIN, LINKS_BEHIND_MAX, BOTH_MAX = 2.5, 1.15, 20.0  # FogROS2-PLR's shape


@dataclass(frozen=True, slots=True)
class Taken:
    """What the counted tasks of one strategy took. `both_percent`: those that two or more servers ran."""

    mean_s: float
    p95_s: float
    p99_s: float
    runs: float
    megabytes: float
    both_percent: float
    failed: int

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> "Taken":
        tasks = list(_counted(outcomes))
        seconds = np.array([one.response_s for one in tasks])
        servers = [sum(site != ONBOARD for site in one.sites) for one in tasks]
        return cls(
            mean_s=float(seconds.mean()),
            p95_s=float(quantile(seconds, 95)),
            p99_s=float(quantile(seconds, 99)),
            runs=float(np.mean([len(one.sites) for one in tasks])),
            megabytes=float(np.mean([one.spent.bytes for one in tasks])) / 1e6,
            both_percent=100 * float(np.mean([count > 1 for count in servers])),
            failed=sum(one.error is not None for one in tasks),
        )


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, metavar="FOLDER", help="recorded runs on two 5G networks")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each (%(default)s)")
    flags = parser.parse_args(argv)
    links = find_recordings(flags.recordings)
    silent = [link for link in links if falls_silent(link)]
    groups = {
        "two networks": list(paired(links)),
        "links that fall silent": list(zip(silent, [*silent[1:], *silent[:1]], strict=True)),
    }
    if not all(groups.values()):
        raise ConfigError(f"{flags.recordings}: n8 and n78 on one kind of road are needed, and silences")
    with SimulationPool() as pool:
        print(servers_table({kind: replicas(kind, pool, flags.seeds) for kind in KINDS}), flush=True)
        for kind in ("plans", "frames"):
            for group, of_group in groups.items():
                found = [two_links(kind, pair, pool, flags.seeds) for pair in of_group]
                print(links_table(f"{kind}, {group}", found), flush=True)
    return 0


def replicas(kind: str, pool: SimulationPool, seeds: int) -> dict[str, Taken]:
    """Three equal servers, each of them slow or without a link for a while."""
    (scenario,) = read_scenarios([str(HERE / "replicas" / f"replicas-{kind}.toml")])
    return _played(_seeded(scenario, seeds), pool)


def two_links(
    kind: str, pair: tuple[RecordedLink, RecordedLink], pool: SimulationPool, seeds: int
) -> dict[str, Taken]:
    """One robot with two links, each to an equal server, as FogROS2-PLR has two 5G providers."""
    (scenario,) = read_scenarios([f"link-{kind}"], tasks=LINK_TASKS)
    rest = {key: value for key, value in scenario.link.items() if "recording" not in key}

    def over(first: RecordedLink, second: RecordedLink) -> list[Scenario]:
        return [
            replace(
                one,
                link=rest,
                servers=tuple(
                    CloudPart(name, link=_from_a_start(link, one.seed))
                    for name, link in ((CLOUD, first), ("second", second))
                ),
            )
            for one in _seeded(scenario, seeds)
        ]

    return _played(over(*pair), pool) | _played(over(pair[1], pair[0]), pool, {OTHER: CLOUD})


def paired(links: Sequence[RecordedLink]) -> Iterator[tuple[RecordedLink, RecordedLink]]:
    """Recordings of the two networks on the same kind of road, each used once."""
    for place in dict.fromkeys(map(_road, links)):
        there = [link for link in links if _road(link) == place]
        yield from zip(
            [link for link in there if "-n78-" in link.name],
            [link for link in there if "-n8-" in link.name],
            strict=False,
        )


def falls_silent(link: RecordedLink) -> bool:
    """Whether one of a hundred messages is held back for SILENCE_MS or more."""
    with link.files["recording"].open(newline="") as file:
        delays = [float(row["rtt_ms"]) for row in csv.DictReader(file) if row.get("rtt_ms")]
    return bool(delays) and float(np.percentile(delays, 99)) >= SILENCE_MS


def _road(link: RecordedLink) -> str:
    return link.name.partition("-n8")[0].partition("-n78")[0]


def servers_table(taken: Mapping[str, Mapping[str, Taken]]) -> Table:
    rows, better = [], {}
    for kind, of in taken.items():
        one, everywhere, ours = of[ONE], of[REPLICATE], of[OFFBOARD]
        better[kind] = one.p99_s / ours.p99_s
        for name, found in of.items():
            rows.append([kind, name, *_cells(found), f"{one.p99_s / found.p99_s:.2f}"])
        rows[-1][-1] += f"; {ours.p99_s / everywhere.p99_s:.2f} of all at once"
    worst = max(of[OFFBOARD].p99_s / of[REPLICATE].p99_s for of in taken.values())
    runs = max(of[OFFBOARD].runs for of in taken.values())
    return Table(
        "Three servers: one, all, or as Offboard chooses",
        ("task", "strategy", "mean ms", "P95 ms", "P99 ms", "runs", "MB", "P99 of one server / this"),
        rows,
        [
            Requirement(
                "P99 of one server / Offboard, best task", max(better.values()), BETTER_MIN, at_least=True
            ),
            Requirement("P99 of Offboard / all servers at once, worst task", worst, BEHIND_MAX),
            Requirement("runs of Offboard for each task, most", runs, RUNS_MAX),
        ],
    )


def links_table(about: str, pairs: Sequence[Mapping[str, Taken]]) -> Table:
    """Geometric means over the pairs of links, with intervals over pairs."""

    def ratios(name: str, base: Any) -> list[float]:
        return [pair[name].p99_s / base(pair) for pair in pairs]

    def single(pair: Mapping[str, Taken]) -> float:
        return min(pair[ONE].p99_s, pair[OTHER].p99_s)

    names = [name for name in STRATEGIES if name != "two servers at once"]
    rows = [
        [
            name.replace("server", "link"),
            str(len(pairs)),
            f"{1e3 * float(np.mean([pair[name].mean_s for pair in pairs])):.0f}",
            f"{1e3 * float(np.mean([pair[name].p99_s for pair in pairs])):.0f}",
            _mean(ratios(name, single)),
            _mean(ratios(name, lambda pair: pair[REPLICATE].p99_s)),
            f"{np.mean([pair[name].both_percent for pair in pairs]):.1f}",
            f"{np.mean([pair[name].runs for pair in pairs]):.2f}",
            f"{np.mean([pair[name].megabytes for pair in pairs]):.3f}",
        ]
        for name in names
    ]
    ours = [1 / one for one in ratios(OFFBOARD, single)]
    behind = _geometric(ratios(OFFBOARD, lambda pair: pair[REPLICATE].p99_s))
    both = float(np.mean([pair[OFFBOARD].both_percent for pair in pairs]))
    return Table(
        f"Two links of one robot: {about}",
        (
            *("strategy", "pairs", "mean ms", "P99 ms", "P99 / better single link", "P99 / both links"),
            *("on both links %", "runs", "MB"),
        ),
        rows,
        [
            Requirement(
                "P99 of the better single link / Offboard", _geometric(ours), LINKS_BETTER_MIN, at_least=True
            ),
            Requirement("P99 of Offboard / both links at once", behind, LINKS_BEHIND_MAX),
            Requirement("tasks of Offboard on both links", both, BOTH_MAX, "%"),
        ],
    )


def _seeded(scenario: Scenario, seeds: int) -> list[Scenario]:
    return [scenario.changed(seed=scenario.seed + n, reference=0) for n in range(seeds)]


def _played(
    units: Sequence[Scenario], pool: SimulationPool, strategies: Mapping[str, str] = STRATEGIES
) -> dict[str, Taken]:
    played = pool.play(units, {name: {"policy": policy} for name, policy in strategies.items()})
    return {name: Taken.of(outcomes) for name, outcomes in played.items()}


def _from_a_start(link: RecordedLink, seed: int) -> dict[str, Any]:
    """The flags of a link that plays this recording from a start that the seed draws."""
    flags: dict[str, Any] = dict(link.files)
    recorded = LinkFlags(**flags).link.up.recording
    assert recorded is not None, "the link has a recording"
    place = Random(f"{seed}/{link.name}").random()
    return {**link.files, "recording_from_s": place * recorded.recording.length_s}


def _counted(outcomes: Sequence[Outcome]) -> Iterator[Answered]:
    return (one for run in outcomes for one in run.answered if one.i >= FROM_TASK)


def _cells(found: Taken) -> list[str]:
    times = (f"{1e3 * seconds:.0f}" for seconds in (found.mean_s, found.p95_s, found.p99_s))
    return [*times, f"{found.runs:.2f}", f"{found.megabytes:.3f}"]


def _geometric(values: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


def _mean(values: Sequence[float]) -> str:
    """The geometric mean and its interval over pairs."""
    picks = np.random.default_rng(1).integers(len(values), size=(RESAMPLES, len(values)))
    means = np.exp(np.log(np.array(values))[picks].mean(axis=1))
    low, high = np.percentile(means, (2.5, 97.5))
    return f"{_geometric(values):.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
