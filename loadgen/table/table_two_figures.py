"""The figures of the paper's Table II, as printed there and over our rows with both times known.

docs/evaluation.md explains every figure and works it out by hand on 12 rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from offboard.common.config import REQUIRED
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_formats import Table, column, headings_of

BLOCK_CELLS_MAX = 1_000_000  # cells of sliding windows or resamples that are in memory at once

Sides = npt.NDArray[np.bool_]  # one value for each task; True: it went to the cloud


@dataclass(frozen=True, slots=True)
class Score:
    """One line of the table: one predictor with one window, or one constant rule, on the `scored` rows.

    None: undefined. `bound` is empty for the figures themselves, or names the end of their interval.
    """

    predictor: str = column("predictor", default=REQUIRED)
    window: str = column("N", default=REQUIRED, latex="$N$")
    bound: str = column("bound", default="")
    r_cloud: float | None = column("r(t^c,d)", 5, latex="$r(t^c,d)$")
    r_onboard: float | None = column("r(t^l,d)", 5, latex="$r(t^l,d)$")
    cloud_s: float | None = column("mean t^c", 5, latex=r"$\bar{t}^c$")
    cloud_predicted_s: float | None = column("mean p^c", 5, latex=r"$\bar{p}^c$")
    cloud_residual_s: float | None = column("cloud res.", 5, latex=r"$\bar{p}^c-\bar{t}^c$")
    onboard_s: float | None = column("mean t^l", 5, latex=r"$\bar{t}^l$")
    onboard_predicted_s: float | None = column("mean p^l", 5, latex=r"$\bar{p}^l$")
    onboard_residual_s: float | None = column("onboard res.", 5, latex=r"$\bar{p}^l-\bar{t}^l$")
    accuracy_percent: float | None = column("accuracy %", 2, latex=r"acc. \%")
    scored: int = column("rows", 0, default=0)
    cloud_residual_percent: float | None = column("cloud res. %", 2, latex=r"res.$^c$ \%")
    onboard_residual_percent: float | None = column("onboard res. %", 2, latex=r"res.$^l$ \%")
    cloud_mae_s: float | None = column("MAE cloud", 5, latex="MAE$^c$")
    onboard_mae_s: float | None = column("MAE onboard", 5, latex="MAE$^l$")
    cloud_p95_s: float | None = column("P95 cloud", 5, latex="P95$^c$")
    onboard_p95_s: float | None = column("P95 onboard", 5, latex="P95$^l$")
    time_over_oracle: float | None = column("time/oracle", 5)
    regret_s: float | None = column("regret s", 5, latex="regret")
    regret_mean_s: float | None = column("regret s/task", 5, latex="regret/task")
    cloud_percent: float | None = column("cloud %", 2)
    note: str = ""


HEADINGS = headings_of(Score)
FIRST = (  # the most important columns
    *("accuracy_percent", "time_over_oracle", "cloud_s", "cloud_predicted_s"),
    *("onboard_s", "onboard_predicted_s", "cloud_mae_s", "onboard_mae_s"),
)

TITLE = "A Predictive Application Offloading Algorithm Using Small Datasets for Cloud Robotics"
SOURCE = f'Penmetcha, Kannan and Min, "{TITLE}", Table II'
PAPER_ROWS = 1000
LSTM_PERCENT = 75.68  # accuracy of the paper's LSTM: 4 hidden layers, batch 50, 80:20 split of the same rows
PAPER_COLUMNS = (
    *("r_cloud", "r_onboard", "cloud_s", "cloud_predicted_s", "cloud_residual_s"),
    *("onboard_s", "onboard_predicted_s", "onboard_residual_s", "accuracy_percent"),
)
_PUBLISHED = {
    "5": (0.31726, 0.73545, 0.14016, 0.17697, 0.03681, 0.17527, 0.19099, 0.01572, 60.02),
    "10": (0.31717, 0.71970, 0.14029, 0.15990, 0.01961, 0.17537, 0.17888, 0.00350, 64.95),
    "20": (0.30455, 0.71198, 0.14005, 0.14595, 0.00590, 0.17546, 0.17807, 0.00260, 70.60),
    "30": (0.30245, 0.70822, 0.14005, 0.14578, 0.00573, 0.17546, 0.18259, 0.00695, 73.38),
    "40": (0.30282, 0.70922, 0.14016, 0.14056, 0.00039, 0.17552, 0.18078, 0.00525, 76.32),
    "50": (0.30273, 0.70641, 0.14025, 0.14061, 0.00036, 0.17554, 0.18027, 0.00473, 78.80),
    "75": (0.29914, 0.69775, 0.13991, 0.139972, 0.00006, 0.17519, 0.177697, 0.00250, 79.74),
    "100": (0.28395, 0.70290, 0.14048, 0.13925, -0.00123, 0.17564, 0.175838, 0.00019, 79.62),
    "500": (0.28060, 0.69707, 0.13481, 0.14012, 0.00531, 0.17113, 0.17649, 0.00536, 81.90),
    "full": (0.27761, 0.69221, 0.14011, 0.14796, 0.00785, 0.17530, 0.18151, 0.00621, 83.32),
}


def _published(window: str, figures: Sequence[float]) -> Score:
    named: dict[str, Any] = dict(zip(PAPER_COLUMNS, figures, strict=True))
    return Score("least-squares", window, **named)


# Table II as the paper prints it, by window.
PUBLISHED = {window: _published(window, figures) for window, figures in _PUBLISHED.items()}


def published_table() -> Table:
    """The columns of the paper, under our headings."""
    where = "on the authors' machines; the paper does not name the feedback mode"
    return Table(
        caption=f"{SOURCE}: {PAPER_ROWS} rows {where}.",
        about={"source": SOURCE, "rows": PAPER_ROWS},
        headings={name: HEADINGS[name] for name in ("window", *PAPER_COLUMNS)},
        lines=list(PUBLISHED.values()),
    )


@dataclass(frozen=True, slots=True)
class Scored:
    """The scored rows: true times, where each task was sent, and the predictions, if there are any.

    All arrays have the same shape (..., rows); figures are computed along the last axis.
    """

    onboard_s: Column
    cloud_s: Column
    to_cloud: Sides
    onboard_predicted_s: Column | None = None
    cloud_predicted_s: Column | None = None

    @classmethod
    def predicted(cls, rows: Rows, onboard_s: Column, cloud_s: Column) -> "Scored":
        """These rows, each sent to the site that is faster by its predicted time."""
        to_cloud = cloud_s < onboard_s  # Eq. 1; a tie stays onboard
        return cls(rows.onboard_s, rows.cloud_s, to_cloud, onboard_s, cloud_predicted_s=cloud_s)

    @property
    def spent_s(self) -> Column:
        """What each task took on its site."""
        return np.where(self.to_cloud, self.cloud_s, self.onboard_s)

    @property
    def best_s(self) -> Column:
        return np.minimum(self.cloud_s, self.onboard_s)

    @property
    def right(self) -> Sides:
        """Whether each task went to the faster site; on a tie, either site is right."""
        found: Sides = self.spent_s == self.best_s
        return found

    def picked(self, picks: npt.NDArray[np.intp]) -> "Scored":
        """The rows with these indices, in their shape."""
        columns: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        known = {name: values[picks] for name, values in columns.items() if values is not None}
        return Scored(**known)


def figures(scored: Scored) -> dict[str, Column]:
    """Every figure except the correlations, by its name in `Score`; NaN if undefined."""
    found = rule_figures(scored)
    for site in ("cloud", "onboard"):
        true, predicted = getattr(scored, f"{site}_s"), getattr(scored, f"{site}_predicted_s")
        if predicted is not None:
            errors = np.abs(predicted - true)
            residual = predicted.mean(-1) - true.mean(-1)
            found[f"{site}_predicted_s"] = predicted.mean(-1)
            found[f"{site}_residual_s"] = residual
            found[f"{site}_residual_percent"] = 100 * divided(residual, true.mean(-1))
            found[f"{site}_mae_s"] = errors.mean(-1)
            found[f"{site}_p95_s"] = quantile(errors, 95)
    return found


def rule_figures(scored: Scored, spent_s: Column | None = None) -> dict[str, Column]:
    """The figures that need no predictions.

    `spent_s`: what each task took, if it may have been more than the time of its site.
    """
    spent_s = scored.spent_s if spent_s is None else spent_s
    best_s = scored.best_s
    return {
        "cloud_s": scored.cloud_s.mean(-1),
        "onboard_s": scored.onboard_s.mean(-1),
        "accuracy_percent": 100 * scored.right.mean(-1),
        "time_over_oracle": divided(spent_s.sum(-1), best_s.sum(-1)),
        "regret_s": (spent_s - best_s).sum(-1),
        "regret_mean_s": (spent_s - best_s).mean(-1),
        "cloud_percent": 100 * scored.to_cloud.mean(-1),
    }


def plain(found: dict[str, Any]) -> dict[str, Any]:
    """The figures as Python numbers; None for NaN and infinity."""
    return {name: float(value) if np.isfinite(value) else None for name, value in found.items()}


def quantile(values: Column, percent: int) -> Column:
    """Nearest rank along the last axis: the smallest value that `percent` of the values do not exceed."""
    rank = -(-percent * values.shape[-1] // 100) - 1
    found: Column = np.partition(values, rank, axis=-1)[..., rank]
    return found


def known_quantile(values: Column, percent: int) -> Column:
    """The same without NaN; NaN if nothing is left."""
    rank = -(-percent * (~np.isnan(values)).sum(axis=-1, keepdims=True) // 100) - 1
    found: Column = np.take_along_axis(np.sort(values, axis=-1), rank, axis=-1)[..., 0]  # NaN come last
    return found


def known_mean(values: Column) -> Column:
    """The mean along the last axis without NaN; NaN if nothing is left."""
    there = ~np.isnan(values)
    return divided(np.where(there, values, 0.0).sum(-1), there.sum(-1).astype(float))


def mean_r(sizes: Column, seconds: Column, length: int) -> float | None:
    """Mean Pearson r over all sliding windows of `length` rows; leaves out windows with a constant column."""
    found = window_r(sizes, seconds, length)
    return float(found.mean()) if len(found) else None


def window_r(sizes: Column, seconds: Column, length: int) -> Column:
    """Pearson r of each sliding window of `length` rows; leaves out windows with a constant column."""
    d, t = sliding_window_view(sizes, length), sliding_window_view(seconds, length)
    step = max(1, BLOCK_CELLS_MAX // length)
    return np.concatenate([_pearson(d[at : at + step], t[at : at + step]) for at in range(0, len(d), step)])


def _pearson(d: Column, t: Column) -> Column:
    """Pearson r of each row of `d` with the same row of `t`; leaves out rows where it is undefined."""
    varied = (np.ptp(d, axis=1) > 0) & (np.ptp(t, axis=1) > 0)
    d, t = _centred(d[varied]), _centred(t[varied])
    found: Column = (d * t).sum(axis=1) / np.sqrt((d * d).sum(axis=1) * (t * t).sum(axis=1))
    return found


def _centred(values: Column) -> Column:
    """Each row minus its mean, scaled to at most 1: no digits cancel, and no square over- or underflows."""
    centred: Column = values - values[:, :1]
    centred -= centred.mean(axis=1, keepdims=True)
    centred /= np.abs(centred).max(axis=1, keepdims=True)
    return centred


def divided(part: Column, whole: Column) -> Column:
    """`part` / `whole`: NaN if `whole` is 0, infinite if it is nearly 0."""
    with np.errstate(over="ignore"):
        return np.divide(part, whole, out=np.full_like(whole, np.nan), where=whole > 0)
