"""Simulates what peers claim on the same shapes of test, next to Offboard.

    python -m benchmarks.claims_of_others PART FOLDER_OF_RECORDINGS [--seeds 3]

- `contended`: three servers, the first of which other robots keep busy
- `in-turn`: three servers, each of them slow or without a link for a while
- `networks`: a robot with two links, recorded on two 5G networks; `silences`: on links that fall silent
- `families`: one server behind each recording of each folder

The rules of peers are in `loadgen/rivals/peer_policies.py`, the tasks in `application_costs`. Tasks before
FROM_TASK do not count: most of them run on all sites. docs/claims_of_others.md says what each system claims.
"""

import argparse
import csv
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.application_costs import NAMES
from benchmarks.measure import Requirement, Table
from benchmarks.peers_played import (
    OFFBOARD,
    ONE,
    OTHER,
    REPLICATE,
    ROBOT_ALONE,
    Taken,
    contended,
    on_one_link,
    on_two_links,
    played,
    slow_in_turn,
)
from offboard.common.command_line import run_command
from offboard.common.errors import ConfigError
from offboard.loadgen.compare.recordings import RecordedLink, find_recordings
from offboard.loadgen.progress import progress
from offboard.loadgen.simulation.simulation_pool import SimulationPool

PROG = "python -m benchmarks.claims_of_others"
CAR = "cicv5g"  # the family that has round trips on two networks
SILENCE_MS = 1000.0
RESAMPLES = 2000
BETTER_MIN, BEHIND_MAX, RUNS_MAX = 5.5, 1.10, 1.3  # FogROS2-FT's shape
LINKS_BETTER_MIN, LINKS_BEHIND_MAX, BOTH_MAX = 2.5, 1.15, 20.0  # FogROS2-PLR's shape
UNKNOWN = "-"
Played = Mapping[str, Taken]


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("recordings", type=Path, metavar="FOLDER", help="a folder for each family of them")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each (%(default)s)")
    flags = parser.parse_args(argv)
    with SimulationPool() as pool:
        print(PARTS[flags.part](flags.recordings, flags.seeds, pool))
    return 0


def _contended(_: Path, seeds: int, pool: SimulationPool) -> Table:
    found = _play([contended(name, seeds) for name in NAMES], pool)
    return servers_table("the first one contended", dict(zip(NAMES, found, strict=True)))


def _in_turn(_: Path, seeds: int, pool: SimulationPool) -> Table:
    found = _play([slow_in_turn(name, seeds) for name in NAMES], pool)
    return servers_table("each slow for a while", dict(zip(NAMES, found, strict=True)))


def _networks(folder: Path, seeds: int, pool: SimulationPool) -> Table:
    return _two_links("two networks", list(paired(_of_a_car(folder))), seeds, pool)


def _silences(folder: Path, seeds: int, pool: SimulationPool) -> Table:
    silent = [link for link in _of_a_car(folder) if falls_silent(link)]
    pairs = list(zip(silent, [*silent[1:], *silent[:1]], strict=True))
    return _two_links("links that fall silent", pairs, seeds, pool)


def _families(folder: Path, seeds: int, pool: SimulationPool) -> Table:
    cases = [on_one_link(name, link, seeds) for name in NAMES for link in find_recordings(folder)]
    found: dict[tuple[str, str], list[Played]] = {}
    for case, taken in zip(cases, _play(cases, pool), strict=True):
        found.setdefault((case.task, case.group), []).append(taken)
    return families_table(found)


PARTS: Mapping[str, Callable[[Path, int, SimulationPool], Table]] = {
    "contended": _contended,
    "in-turn": _in_turn,
    "networks": _networks,
    "silences": _silences,
    "families": _families,
}


def _play(cases: Sequence[object], pool: SimulationPool) -> Iterator[dict[str, Taken]]:
    with progress("simulating", len(cases)) as shown:
        for found in pool.map(played, cases):
            shown.step()
            yield found


def _two_links(
    about: str, pairs: Sequence[tuple[RecordedLink, RecordedLink]], seeds: int, pool: SimulationPool
) -> Table:
    if not pairs:
        raise ConfigError("n8 and n78 on one kind of road are needed, and silences")
    found = {}
    for name in NAMES:
        both = [on_two_links(name, pair, seeds) for pair in pairs]
        first = _play([one for one, _ in both], pool)
        found[name] = [
            {**taken, OTHER: other[ONE]}
            for taken, other in zip(first, _play([two for _, two in both], pool), strict=True)
        ]
    return links_table(about, found)


def _of_a_car(folder: Path) -> list[RecordedLink]:
    return [link for link in find_recordings(folder) if link.family == CAR]


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


def servers_table(about: str, taken: Mapping[str, Played]) -> Table:
    rows = [
        [task, name, *_cells([found]), f"{of[ONE].percentile_s(99) / found.percentile_s(99):.2f}"]
        for task, of in taken.items()
        for name, found in of.items()
    ]
    ours = {task: of[OFFBOARD].percentile_s(99) for task, of in taken.items()}
    better = max(of[ONE].percentile_s(99) / ours[task] for task, of in taken.items())
    worst = max(ours[task] / of[REPLICATE].percentile_s(99) for task, of in taken.items())
    runs = max(of[OFFBOARD].runs or 0.0 for of in taken.values())
    return Table(
        f"Three servers, {about}",
        ("task", "strategy", "mean ms", "P95 ms", "P99 ms", "runs", "MB", "P99 of one server / this"),
        rows,
        [
            Requirement("P99 of one server / Offboard, best task", better, BETTER_MIN, at_least=True),
            Requirement("P99 of Offboard / all servers at once, worst task", worst, BEHIND_MAX),
            Requirement("runs of Offboard for each task, most", runs, RUNS_MAX),
        ],
    )


def links_table(about: str, taken: Mapping[str, Sequence[Played]]) -> Table:
    """Means over the pairs of links; those of ratios are geometric, with intervals over pairs."""
    rows, better, behind = [], [], []
    for task, pairs in taken.items():
        p99_s = {name: np.array([one[name].percentile_s(99) for one in pairs]) for name in pairs[0]}
        single = np.minimum(p99_s[ONE], p99_s[OTHER])
        better.append(_geometric(single / p99_s[OFFBOARD]))
        behind.append(_geometric(p99_s[OFFBOARD] / p99_s[REPLICATE]))
        for name in pairs[0]:
            found = [pair[name] for pair in pairs]
            rows.append([
                task,
                name.replace("server", "link"),
                *_cells(found),
                _mean(p99_s[name] / single),
                _mean(p99_s[name] / p99_s[REPLICATE]),
                f"{np.mean([one.both_percent for one in found]):.1f}",
            ])  # fmt: skip
    both = max(float(np.mean([one[OFFBOARD].both_percent for one in pairs])) for pairs in taken.values())
    return Table(
        f"Two links of one robot, {about}: {len(next(iter(taken.values())))} pairs",
        (
            *("task", "strategy", "mean ms", "P95 ms", "P99 ms", "runs", "MB"),
            *("P99 / better single link", "P99 / both links", "on both links %"),
        ),
        rows,
        [
            Requirement(
                "P99 of the better single link / Offboard, best task",
                max(better),
                LINKS_BETTER_MIN,
                at_least=True,
            ),
            Requirement("P99 of Offboard / both links at once, worst task", max(behind), LINKS_BEHIND_MAX),
            Requirement("tasks of Offboard on both links, most", both, BOTH_MAX, "%"),
        ],
    )


def families_table(taken: Mapping[tuple[str, str], Sequence[Played]]) -> Table:
    """Means over recordings; those of ratios to the better constant are geometric, with intervals."""
    rows = []
    for (task, family), links in taken.items():
        better = [min((one[ONE], one[ROBOT_ALONE]), key=lambda of: of.mean_s) for one in links]
        for name in links[0]:
            found = [one[name] for one in links]
            means = [one.mean_s / base.mean_s for one, base in zip(found, better, strict=True)]
            tails = [
                one.percentile_s(99) / base.percentile_s(99)
                for one, base in zip(found, better, strict=True)
            ]  # fmt: skip
            shown = "always cloud" if name == ONE else name
            rows.append([task, family, shown, *_cells(found), _mean(means), _mean(tails)])
    counts = {family: len(links) for (_, family), links in taken.items()}
    said = ", ".join(f"{count} of {family}" for family, count in counts.items())
    return Table(
        f"One server behind recorded links: {said}",
        (
            *("task", "family", "strategy", "mean ms", "P95 ms", "P99 ms", "runs", "MB"),
            *("mean / better constant", "P99 / better constant"),
        ),
        rows,
    )


def _cells(found: Sequence[Taken]) -> list[str]:
    """Mean, P95 and P99 in ms, runs and MB of a task: means over the links that these are of."""
    times = np.array([[one.mean_s, one.percentile_s(95), one.percentile_s(99)] for one in found])
    runs = [one.runs for one in found if one.runs is not None]
    megabytes = [one.megabytes for one in found if one.megabytes is not None]
    return [
        *(f"{1e3 * mean_s:.0f}" for mean_s in times.mean(axis=0)),
        f"{np.mean(runs):.2f}" if runs else UNKNOWN,
        f"{np.mean(megabytes):.3f}" if megabytes else UNKNOWN,
    ]


def _geometric(values: Iterable[float]) -> float:
    return float(np.exp(np.mean(np.log(np.array(values)))))


def _mean(values: Sequence[float]) -> str:
    """The geometric mean and its interval over links."""
    picks = np.random.default_rng(1).integers(len(values), size=(RESAMPLES, len(values)))
    means = np.exp(np.log(np.array(values))[picks].mean(axis=1))
    low, high = np.percentile(means, (2.5, 97.5))
    return f"{_geometric(values):.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
