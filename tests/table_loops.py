"""Table II of the paper in plain loops, without project code or numpy, and functions that read tables."""

import csv
import io
import math
import random
import re
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

PAGE = (Path(__file__).parents[1] / "docs" / "evaluation.md").read_text(encoding="utf-8")
UNDEFINED = "–"  # noqa: RUF001

Line = tuple[float, float, float]  # size, onboard_s, cloud_s


class Step(NamedTuple):
    """What the plain loops found for one scored row."""

    p_onboard: float
    p_cloud: float
    cloud: bool


def fit(window: list[tuple[float, float]], size: float) -> Any:
    """Least squares by the formula of the paper."""
    mean_d = sum(d for d, _ in window) / len(window)
    mean_t = sum(t for _, t in window) / len(window)
    sdd = sum((d - mean_d) ** 2 for d, _ in window)
    slope = sum((d - mean_d) * (t - mean_t) for d, t in window) / sdd if sdd else 0
    return slope * size + (mean_t - slope * mean_d)


def replay(rows: list[Line], first: int, length: int, feedback: str) -> list[Step]:
    """Algorithm 1 on rows `first`.. with windows of `length`; feedback "none": nothing is learnt after."""
    onboard = [(d, t) for d, t, _ in rows[:first]]
    cloud = [(d, t) for d, _, t in rows[:first]]
    steps = []
    for size, onboard_s, cloud_s in rows[first:]:
        p_onboard, p_cloud = fit(onboard, size), fit(cloud, size)
        steps.append(Step(p_onboard, p_cloud, p_cloud < p_onboard))
        if feedback == "full" or (feedback == "chosen" and p_cloud < p_onboard):
            cloud = [*cloud, (size, cloud_s)][-length:]
        if feedback == "full" or (feedback == "chosen" and not p_cloud < p_onboard):
            onboard = [*onboard, (size, onboard_s)][-length:]
    return steps


def pearson(d: list[float], t: list[float]) -> float | None:
    if min(d) == max(d) or min(t) == max(t):
        return None
    mean_d, mean_t = sum(d) / len(d), sum(t) / len(t)
    sdt = sum((x - mean_d) * (y - mean_t) for x, y in zip(d, t, strict=True))
    return sdt / math.sqrt(sum((x - mean_d) ** 2 for x in d) * sum((y - mean_t) ** 2 for y in t))


def mean_r(d: list[float], t: list[float], length: int) -> float | None:
    found = [pearson(d[at : at + length], t[at : at + length]) for at in range(len(d) - length + 1)]
    defined = [r for r in found if r is not None]
    return sum(defined) / len(defined) if defined else None


def expected_line(rows: list[Line], label: str, feedback: str) -> list[str]:
    """The printed cells of line N."""
    split = label == "full"
    length = int(0.8 * len(rows)) if split else int(label)
    steps = replay(rows, length, length, "none" if split else feedback)
    scored = rows[length:]
    count = len(scored)
    cells = [label, *(printed(r) for r in correlations(tuple(rows), len(rows) if split else length))]
    errors, percents = {}, {}
    for side, predicted in ((2, [s.p_cloud for s in steps]), (1, [s.p_onboard for s in steps])):
        true = [row[side] for row in scored]
        mean_t, mean_p = sum(true) / count, sum(predicted) / count
        cells += [printed(mean_t), printed(mean_p), printed(mean_p - mean_t)]
        percents[side] = f"{round(100 * (mean_p - mean_t) / mean_t, 2) + 0.0:.2f}"
        errors[side] = sorted(abs(p - t) for p, t in zip(predicted, true, strict=True))
    rank = math.ceil(Fraction(95, 100) * count)
    right, *rule = rule_cells(scored, [step.cloud for step in steps])
    cells += [right, str(count), percents[2], percents[1]]
    cells += [printed(sum(errors[side]) / count) for side in (2, 1)]
    cells += [printed(errors[side][rank - 1]) for side in (2, 1)]
    return cells + rule


@cache
def correlations(rows: tuple[Line, ...], length: int) -> list[float | None]:
    return [mean_r([row[0] for row in rows], [row[side] for row in rows], length) for side in (2, 1)]


def rule_cells(rows: list[Line], to_cloud: list[bool]) -> list[str]:
    """Accuracy, time/oracle, regret, regret a task, share of cloud."""
    spent = [
        cloud_s if cloud else onboard_s for (_, onboard_s, cloud_s), cloud in zip(rows, to_cloud, strict=True)
    ]
    best = [min(onboard_s, cloud_s) for _, onboard_s, cloud_s in rows]
    right = sum(1 for s, b in zip(spent, best, strict=True) if s == b)
    regret = sum(s - b for s, b in zip(spent, best, strict=True))
    return [
        f"{100 * right / len(rows):.2f}",
        printed(sum(spent) / sum(best)),
        printed(regret),
        printed(regret / len(rows)),
        f"{100 * sum(to_cloud) / len(rows):.2f}",
    ]


def constant_line(rows: list[Line], label: str, to_cloud: list[bool]) -> list[str]:
    mean = [printed(sum(row[side] for row in rows) / len(rows)) for side in (2, 1)]
    right, *rule = rule_cells(rows, to_cloud)
    none = [UNDEFINED, UNDEFINED]
    return [label, *none, mean[0], *none, mean[1], *none, right, str(len(rows)), *none, *none, *none, *rule]


def expected_table(rows: list[Line], labels: tuple[str, ...], feedback: str) -> list[list[str]]:
    return [
        *(expected_line(rows, label, feedback) for label in labels),
        constant_line(rows, "always-onboard", [False] * len(rows)),
        constant_line(rows, "always-cloud", [True] * len(rows)),
        constant_line(rows, "oracle", [cloud_s < onboard_s for _, onboard_s, cloud_s in rows]),
    ]


def printed(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.5f}".replace("-0.00000", "0.00000")


def csv_of(rows: list[Line]) -> str:
    return "size,onboard_s,cloud_s\n" + "".join(
        f"{d!r},{onboard!r},{cloud!r}\n" for d, onboard, cloud in rows
    )


def rows_of(text: str) -> list[Line]:
    lines = csv.DictReader(io.StringIO(text))
    return [(float(one["size"]), float(one["onboard_s"]), float(one["cloud_s"])) for one in lines]


def lines_of(markdown: str) -> list[list[str]]:
    """The cells of the lines below the heading of the only table in `markdown`."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def section(heading: str) -> str:
    """The text of the page below `heading`, up to the next one."""
    found = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found, f"docs/evaluation.md has no section {heading!r}"
    return found[1]


def synthetic(count: int, seed: int) -> list[Line]:
    """Times that depend on size strongly onboard and weakly in the cloud, as the paper's.

    With all their digits: a total of times of 6 places often lies halfway between two printed ones.
    """
    g = random.Random(seed)
    rows = []
    for _ in range(count):
        d = g.uniform(0, 5)
        onboard_s = max(0.01, 0.10 + 0.03 * d + g.gauss(0, 0.045))
        rows.append((d, onboard_s, 0.11 + 0.012 * d + g.expovariate(1 / 0.045)))
    return rows


THOUSAND = synthetic(1000, seed=7)
TWELVE = re.search(r"```csv\n(.*?)```", PAGE, re.DOTALL)[1]  # type: ignore[index]
