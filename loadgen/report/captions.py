"""The charts of a report with their titles and captions, which say what is shown and how it was computed.

The charts are drawn in `charts.py`.
"""

from dataclasses import dataclass
from typing import Any

from offboard.loadgen.replay.replay import ORACLE, RECORDED
from offboard.loadgen.report.chart_data import POINTS_MAX, Times
from offboard.loadgen.report.findings import Findings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

NO_WINDOW = "Not drawn: there are too few rows to fill any window and predict the next row."


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart of a report.

    `shown` is the data for `charts.draw`. None: the chart cannot be drawn, for the reason in the caption.
    """

    name: str
    title: str
    caption: str
    shown: Any = None


def all_charts(findings: Findings) -> list[Chart]:
    """All charts, in the order of the page."""
    return [
        _times(findings),
        _decisions(findings),
        _errors(findings),
        _accuracy(findings),
        _distributions(findings),
    ]


def _times(findings: Findings) -> Chart:
    name, title, shown = "times", "Execution time by input size", findings.times
    if shown is None:
        return Chart(name, title, "Not drawn: no task ran on both sites.")
    count = len(findings.rows)
    caption = (
        f"The same {count:,} tasks on both sites. The lines are least-squares fits over all of them. "
        f"{_crossing(shown)}{_thinned(count)}"
    )
    return Chart(name, title, caption, shown)


def _decisions(findings: Findings) -> Chart:
    name, title, shown = "decisions", "Decisions over time", findings.decisions
    if shown is None:
        return Chart(name, title, _too_few(findings))
    below = f"Below: the share of the cloud among the latest {shown.over} tasks."
    if shown.policy == RECORDED:
        caption = (
            f"Above: how long the robot waited for each task, and the site that it chose. {below} "
            f"{shown.of:,} tasks as recorded, with the robot's own predictor and N; feedback chosen."
            f"{_thinned(shown.of)}"
        )
        return Chart(name, title, caption, shown)
    caption = (
        f"Above: the time of each task on the site that policy {shown.policy} chose. {below} "
        f"{_replay_of(findings)}.{_thinned(shown.of)}"
    )
    return Chart(name, title, caption, shown)


def _errors(findings: Findings) -> Chart:
    name, title = "errors", "Prediction error by window size"
    shown = [score for score in findings.scores if None not in (score.onboard_mae_s, score.cloud_mae_s)]
    if not shown:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "The mean absolute error (MAE) of the predictions, and the residual without its sign. "
        "The residual is a difference of two means, so positive and negative errors cancel. "
        f"{_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _accuracy(findings: Findings) -> Chart:
    name, title, shown = "accuracy", "Accuracy by window size", findings.accuracies
    if shown is None:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "The share of tasks that were sent to the site that was really faster. "
        f"The band is the 95 % interval for {findings.settings.predictor}. "
        "The figures in the paper come from other computers. "
        f"Level lines are policies that do not predict, over all rows. {_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _distributions(findings: Findings) -> Chart:
    name, title, shown = "ecdf", "Execution time by policy", findings.spent_s
    if not shown:
        return Chart(name, title, _too_few(findings))
    basis = [_replay_of(findings)] if ORACLE in shown else []
    if RECORDED in shown:
        basis.append(
            f"{RECORDED}: the {len(shown[RECORDED]):,} tasks that the robot decided, feedback chosen"
        )
    caption = f"The share of tasks that were done within a given time. {'; '.join(basis)}."
    return Chart(name, title, caption, shown)


def _crossing(times: Times) -> str:
    """Where the lines cross, as a sentence."""
    if times.low == times.high:
        return "They are level, because all tasks have the same size."
    if times.crossing is None:
        return "They are parallel."
    at = f"d = {times.crossing:.4g}"
    if not times.crossing_inside:
        faster = ONBOARD if times.onboard.mean_seconds < times.cloud.mean_seconds else CLOUD
        return f"They cross at {at}, outside the measured sizes: {faster} is faster on average."
    small, large = (ONBOARD, CLOUD) if times.onboard.slope > times.cloud.slope else (CLOUD, ONBOARD)
    return f"They cross at {at}: on average, {small} is faster for smaller tasks and {large} for larger ones."


def _replay_of(findings: Findings) -> str:
    settings = findings.settings
    return (
        f"Replay of {len(findings.scored):,} of {len(findings.rows):,} rows, after a warm-up of "
        f"N = {settings.length}; predictor {settings.predictor}, feedback {settings.feedback}"
    )


def _every_n(findings: Findings) -> str:
    names = list(dict.fromkeys(score.predictor for score in findings.scores if score.predictor))
    predictors = f"predictor{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return f"{len(findings.rows):,} rows for every N; {predictors}; feedback {findings.settings.feedback}"


def _too_few(findings: Findings) -> str:
    return (
        f"Not drawn: the warm-up of N = {findings.settings.length} needs all of the "
        f"{len(findings.rows):,} rows, and no task was decided live."
    )


def _thinned(count: int) -> str:
    return f" {POINTS_MAX:,} of {count:,} points are drawn." if count > POINTS_MAX else ""
