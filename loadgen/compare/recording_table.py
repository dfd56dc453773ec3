"""The tables of a comparison over recordings: by family, and the recordings where a policy is behind.

The recording is the unit of every mean and interval: tasks of one recording share its link.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from offboard.common.config import REQUIRED
from offboard.loadgen.compare.compare_settings import CONSTANTS, CompareConfig
from offboard.loadgen.compare.recordings import MEAN_BEHIND, P99_BEHIND, USABLE, Figures
from offboard.loadgen.table.confidence_intervals import BOUNDS, Blocks, Picks
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import MARKDOWN, Table, column, headings_of

LEVEL = 0.01  # a mean that differs by less is called level
CSV = "csv"


@dataclass(frozen=True, slots=True)
class Comparison:
    """A scenario over all recordings. `taken_from_link` says by family what the recordings do not hold."""

    scenario: str
    tasks: int
    arrivals: str
    figures: Sequence[Figures]
    taken_from_link: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class FamilyLine:
    """A policy over the recordings of a family: geometric means of ratios to the better constant.

    - `worst`: the recording with the largest ratio of the means, which is `worst_mean`
    - `behind`: recordings where the mean is more than 3 % or the P99 more than 10 % above the constant's
    - `over_oracle`: geometric mean of time / oracle, where the simulation knows it
    """

    family: str = column("family", default=REQUIRED)
    policy: str = column("policy", default=REQUIRED)
    bound: str = column("bound", default="")
    recordings: int = column("recordings", 0, default=0)
    mean_ratio: float | None = column("mean / constant", 3)
    worst_mean: float | None = column("worst", 3)
    p99_ratio: float | None = column("P99 / constant", 3)
    worst_p99: float | None = column("worst P99", 2)
    behind: int | None = column("behind", 0)
    over_oracle: float | None = column("time / oracle", 3)
    cloud_percent: float | None = column("used cloud %", 1)
    lost: int | None = column("lost", 0)
    worst: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingLine:
    """A policy over one recording."""

    family: str
    recording: str = column("recording", default=REQUIRED)
    policy: str = column("policy", default=REQUIRED)
    better: str = column("constant", default=REQUIRED)
    usable: str = column("usable", default=REQUIRED)
    mean_ms: float = column("mean ms", 1, default=REQUIRED)
    mean_ratio: float = column("mean / it", 3, default=REQUIRED)
    p99_ms: float
    p99_ratio: float = column("P99 / it", 3, default=REQUIRED)
    over_oracle: float | None = column("time / oracle", 3, default=REQUIRED)
    cloud_percent: float
    lost: int
    note: str = ""


HEADINGS = headings_of(FamilyLine)
SHOWN = ("recording", "policy", "better", "usable", "mean_ratio", "p99_ratio", "mean_ms", "over_oracle")
OF_RECORDINGS = {name: headings_of(RecordingLine)[name] for name in SHOWN}


def tables(compared: Sequence[Comparison], config: CompareConfig) -> str:
    """All tables as text: those of the families first. CSV and JSON hold every recording."""
    by_family = [family_table(one, config) for one in compared]
    each = [recording_table(one, config) for one in compared]
    if config.format == CSV:  # the tables have different columns
        return config.text(by_family) + "\n" + config.text(each)
    text = config.text([*by_family, *(table for table in each if table.lines)])
    if config.format != MARKDOWN:
        return text
    return "\n".join([text, *(line for one in compared for line in sentences(one, config)), ""])


def family_table(compared: Comparison, config: CompareConfig) -> Table:
    """One line for each family and policy; the ends of the intervals below it, from 10 recordings on."""
    families = by_family(compared.figures)
    policies = config.policies
    lines = [line for name, of in families.items() for one in policies for line in _lines(name, of, one)]
    caption = (
        f"Scenario {compared.scenario} over recorded links ({config.where}): {compared.tasks} tasks,"
        f" {compared.arrivals}, {config.count_of_seeds}. The constant is onboard or cloud, the one with the"
        " smaller mean on that recording. Means over recordings are geometric, and a recording is the unit of"
        " the 95 % intervals."
    )
    given = compared.taken_from_link.items()
    notes = [f"{name}: not recorded, and therefore taken from [link]: {text}." for name, text in given]
    if config.format != MARKDOWN:  # which ends with them
        notes += sentences(compared, config)
    about = {"scenario": compared.scenario, "testbed": config.where, "arrivals": compared.arrivals}
    first = ("recordings", "mean_ratio", "worst_mean", "p99_ratio", "behind", "over_oracle")
    return Table(caption, about, HEADINGS, lines, notes=tuple(notes), first=first)


def recording_table(compared: Comparison, config: CompareConfig) -> Table:
    """One line for each recording and policy; in text, only where a policy that decides is behind."""
    text = config.format not in (CSV, "json")
    lines = [
        _recording_line(one, policy)
        for one in compared.figures
        for policy in config.policies
        if not text or (policy not in CONSTANTS and one.behind(policy))
    ]
    lines.sort(key=lambda line: -line.mean_ratio)
    caption = (
        f"Scenario {compared.scenario}, {compared.arrivals}: recordings where a policy is more than"
        f" {100 * (MEAN_BEHIND - 1):.0f} % behind the mean of the better constant, or"
        f" {100 * (P99_BEHIND - 1):.0f} % behind its P99. A link is usable if cloud takes at most"
        f" {USABLE:g} times as long as onboard."
    )
    about = {"scenario": compared.scenario, "arrivals": compared.arrivals}
    return Table(caption, about, OF_RECORDINGS, lines)


def by_family(figures: Iterable[Figures]) -> dict[str, list[Figures]]:
    found: dict[str, list[Figures]] = {}
    for one in figures:
        found.setdefault(one.family, []).append(one)
    return found


def sentences(compared: Comparison, config: CompareConfig) -> list[str]:
    """For each policy that decides, how it does in this scenario."""
    families, deciding = by_family(compared.figures), [one for one in config.policies if one not in CONSTANTS]
    return [f"{compared.scenario}: {sentence(policy, families)}" for policy in deciding]


def sentence(policy: str, families: Mapping[str, Sequence[Figures]]) -> str:
    """How a policy does against the better constant, in words."""
    means = {name: geometric([one.mean_ratio(policy) for one in of]) for name, of in families.items()}
    ahead = [ratio for ratio in means.values() if ratio < 1 - LEVEL]
    behind = {name: ratio for name, ratio in means.items() if ratio > 1 + LEVEL}
    parts = []
    if ahead:
        parts.append(f"ahead in {len(ahead)} (by {_span(ahead)})")
    if level := len(means) - len(ahead) - len(behind):
        parts.append(f"level in {level}")
    if behind:
        names = ", ".join(behind)
        parts.append(f"behind in {len(behind)} (by {_span(list(behind.values()))}: {names})")
    worst = max((one for of in families.values() for one in of), key=lambda one: one.mean_ratio(policy))
    ratio = worst.mean_ratio(policy)
    how = f"{100 * (ratio - 1):.0f} % behind" if ratio >= 1 else f"{100 * (1 - ratio):.0f} % ahead"
    of_all = "one family" if len(means) == 1 else f"{len(means)} families"
    return (
        f"{policy} against the better constant in {of_all}: {', '.join(parts)};"
        f" in its worst recording, {worst.family}/{worst.recording}, it is {how}."
    )


def geometric(ratios: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(ratios))))


def _span(ratios: Sequence[float]) -> str:
    percents = sorted({round(100 * abs(ratio - 1)) for ratio in ratios})
    return f"{percents[0]} %" if len(percents) == 1 else f"{percents[0]} to {percents[-1]} %"


def _lines(family: str, of: Sequence[Figures], policy: str) -> list[FamilyLine]:
    """The line of a policy in a family, and those of its interval."""
    worst = max(of, key=lambda one: one.mean_ratio(policy))
    columns = {
        "mean_ratio": [one.mean_ratio(policy) for one in of],
        "p99_ratio": [one.p99_ratio(policy) for one in of],
    }
    oracle = [one.taken[policy].over_oracle for one in of]
    known = [value for value in oracle if value is not None]
    if len(known) == len(of):
        columns["over_oracle"] = known
    logs = {name: np.log(values) for name, values in columns.items()}
    measured: dict[str, Any] = {name: float(np.exp(values.mean())) for name, values in logs.items()}

    def resampled(picks: Picks) -> dict[str, Column]:
        return {name: np.exp(values[picks].mean(axis=-1)) for name, values in logs.items()}

    ends = Blocks(len(of), length=1).intervals(resampled)
    line = FamilyLine(
        family,
        policy,
        recordings=len(of),
        worst_mean=worst.mean_ratio(policy),
        worst_p99=max(columns["p99_ratio"]),
        behind=sum(one.behind(policy) for one in of),
        cloud_percent=float(np.mean([one.taken[policy].cloud_percent for one in of])),
        lost=sum(one.taken[policy].lost for one in of),
        worst=worst.recording,
        **measured,
    )
    bounds = zip(BOUNDS, ends, strict=True)
    return [line, *(FamilyLine(family, policy, name, len(of), **bound) for name, bound in bounds if bound)]


def _recording_line(one: Figures, policy: str) -> RecordingLine:
    taken = one.taken[policy]
    return RecordingLine(
        family=one.family,
        recording=f"{one.family}/{one.recording}",
        policy=policy,
        better=one.better,
        usable="yes" if one.usable else "no",
        mean_ms=1e3 * taken.mean_s,
        mean_ratio=one.mean_ratio(policy),
        p99_ms=1e3 * taken.p99_s,
        p99_ratio=one.p99_ratio(policy),
        over_oracle=taken.over_oracle,
        cloud_percent=taken.cloud_percent,
        lost=taken.lost,
    )
