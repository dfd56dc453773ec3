"""Figures of `benchmarks.asking`: how right intervals and probabilities were, and what observing found.

`asking_robot` writes the lines that they are computed from.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.measure import Requirement, Table

COVERAGE = (85.0, 95.0)  # percent of the times that 90 % intervals should hold
ERROR_MAX = 5.0  # points between predicted and met deadlines, in the mean of the groups
CALLS_MIN = 500
GROUPS = 5  # of calls with neighbouring probabilities; with more groups, chance alone exceeds ERROR_MAX
CHANCES = 1_000  # times that a perfect prediction is drawn
NORMAL_90 = 1.645
WARM_UP_TASKS = 10  # at the start, where the robot that offloads still runs tasks on both sites

Line = Mapping[str, Any]


def expectation_table(runs: Mapping[str, Sequence[Line]]) -> Table:
    """Coverage and calibration by application and site, and of all calls; `runs` are by application."""
    rows = [
        _row(name, site, [line for line in lines if line["site"] == site])
        for name, lines in runs.items()
        for site in sorted({line["site"] for line in lines})
    ]
    every = [line for lines in runs.values() for line in lines]
    held, error = coverage(every), calibration_error(every)
    return Table(
        "expect: intervals and probabilities against what happened",
        ("application", "site", "calls", "in 90 % interval", "width / expected", "calibration error, points"),
        [*rows, _row("all", "all", every)],
        [
            Requirement("calls with a probability", len(_told(every)), CALLS_MIN, at_least=True),
            Requirement("times in their interval", held, COVERAGE[0], "%", at_least=True),
            Requirement("times in their interval", held, COVERAGE[1], "%"),
            Requirement("calibration error", error, ERROR_MAX, "points"),
        ],
    )


def group_table(runs: Mapping[str, Sequence[Line]]) -> Table:
    """The deadlines of all calls, in groups of neighbouring probabilities."""
    told = _told([line for lines in runs.values() for line in lines])
    rows = [
        [str(len(group)), f"{100 * np.mean(group[:, 0]):.1f}", f"{100 * np.mean(group[:, 1]):.1f}"]
        for group in _groups(told)
    ]
    chance = chance_error(told)
    title = f"deadlines met; a perfect prediction would have an error of {chance:.1f} points by chance"
    return Table(title, ("calls", "predicted %", "met %"), rows)


def savings_table(runs: Mapping[str, Sequence[Line]]) -> Table:
    """The estimated saving of each application next to the true one."""
    rows, requirements = [], []
    for name, lines in runs.items():
        last, (true_ms, half_ms) = lines[-1]["savings"], true_saving_ms(lines)
        sent = 100 * np.mean([line["used"] != "onboard" for line in lines[WARM_UP_TASKS:]])
        true = f"{true_ms:.1f} [{true_ms - half_ms:.1f}, {true_ms + half_ms:.1f}]"
        if last is None:
            rows.append([name, str(len(lines)), "0", "unknown", true, "-", f"{sent:.0f}"])
            requirements.append(Requirement(f"{name}: estimates", 0, 1, at_least=True))
            continue
        mean_ms, low_ms, high_ms = (1e3 * last[one] for one in ("mean_s", "low_s", "high_s"))
        estimate = f"{mean_ms:.1f} [{low_ms:.1f}, {high_ms:.1f}]"
        rows.append(
            [
                name,
                str(last["tasks"]),
                str(last["probes"]),
                estimate,
                true,
                f"{100 * last['sent']:.0f}",
                f"{sent:.0f}",
            ]
        )
        requirements += [
            Requirement(f"{name}: true saving", true_ms, round(low_ms, 1), "ms", at_least=True),
            Requirement(f"{name}: true saving", true_ms, round(high_ms, 1), "ms"),
        ]
    columns = ("application", "tasks", "probes", "estimated ms", "true ms", "would be sent %", "sent %")
    return Table("observe: saving per task, with 90 % intervals", columns, rows, requirements)


def coverage(lines: Sequence[Line]) -> float:
    """Percent of the answered calls whose time was inside the interval that was expected."""
    held = [
        line["interval"][0] <= line["took_s"] <= line["interval"][1]
        for line in lines
        if line["interval"] is not None and line["took_s"] is not None
    ]
    return 100 * float(np.mean(held)) if held else math.nan


def calibration_error(lines: Sequence[Line]) -> float:
    """Mean distance between predicted and true share of met deadlines, in points, over GROUPS groups."""
    return _error(_told(lines))


def chance_error(told: Sequence[tuple[float, bool]]) -> float:
    """The calibration error that a perfect prediction has in the mean, because the calls are few."""
    rng, chances = np.random.default_rng(1), np.array([chance for chance, _ in told])
    drawn = (list(zip(chances, rng.random(len(chances)) < chances, strict=True)) for _ in range(CHANCES))
    return float(np.mean([_error(one) for one in drawn])) if len(told) else math.nan


def true_saving_ms(lines: Sequence[Line]) -> tuple[float, float]:
    """Mean of what offloading really saved per task, and half of its 90 % interval."""
    saved = [1e3 * (line["observed_s"] - line["sent_s"]) for line in lines[WARM_UP_TASKS:]]
    return float(np.mean(saved)), NORMAL_90 * float(np.std(saved, ddof=1)) / math.sqrt(len(saved))


def _row(name: str, site: str, lines: Sequence[Line]) -> list[str]:
    widths = [
        (line["interval"][1] - line["interval"][0]) / line["seconds"]
        for line in lines
        if line["interval"] is not None and line["seconds"]
    ]
    width = f"{np.median(widths):.2f}" if widths else "-"
    error = f"{calibration_error(lines):.1f}"
    return [name, site, str(len(lines)), f"{coverage(lines):.1f} %", width, error]


def _told(lines: Sequence[Line]) -> list[tuple[float, bool]]:
    """The probability of each call that had one, and whether it met its deadline."""
    return [(line["in_time"], line["met"]) for line in lines if line["in_time"] is not None]


def _groups(told: Sequence[tuple[float, bool]]) -> Iterator[Any]:
    """GROUPS groups of equally many calls, by probability; each is an array of probabilities and outcomes."""
    ordered = np.array(sorted(told, key=lambda one: one[0]), float).reshape(-1, 2)
    return (group for group in np.array_split(ordered, GROUPS) if len(group))


def _error(told: Sequence[tuple[float, bool]]) -> float:
    errors = [abs(np.mean(group[:, 0]) - np.mean(group[:, 1])) for group in _groups(told)]
    return 100 * float(np.mean(errors)) if errors else math.nan
