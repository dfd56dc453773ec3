"""The figures of the paper's Table II, and the ones that we add, over rows with both times known.

docs/evaluation.md explains every figure and works it out by hand on 12 rows.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import Heading

BLOCK_CELLS_MAX = 1_000_000  # cells of sliding windows or resamples that are in memory at once

Sides = npt.NDArray[np.bool_]  # one value for each task; True: it went to the cloud


@dataclass(frozen=True, slots=True)
class Score:
    """One line of the table: one predictor with one window, or one constant rule, on the `scored` rows.

    None: undefined. `bound` is empty for the figures themselves, or names the end of their interval.
    """

    predictor: str
    window: str
    bound: str = ""
    r_cloud: float | None = None
    r_onboard: float | None = None
    cloud_s: float | None = None
    cloud_predicted_s: float | None = None
    cloud_residual_s: float | None = None
    onboard_s: float | None = None
    onboard_predicted_s: float | None = None
    onboard_residual_s: float | None = None
    accuracy_percent: float | None = None
    scored: int = 0
    cloud_residual_percent: float | None = None
    onboard_residual_percent: float | None = None
    cloud_mae_s: float | None = None
    onboard_mae_s: float | None = None
    cloud_p95_s: float | None = None
    onboard_p95_s: float | None = None
    time_over_oracle: float | None = None
    regret_s: float | None = None
    regret_mean_s: float | None = None
    cloud_percent: float | None = None
    note: str = ""


HEADINGS: dict[str, Heading] = {
    "predictor": Heading("predictor", "predictor", None),
    "window": Heading("N", "$N$", None),
    "bound": Heading("bound", "bound", None),
    "r_cloud": Heading("r(t^c,d)", "$r(t^c,d)$", 5),
    "r_onboard": Heading("r(t^l,d)", "$r(t^l,d)$", 5),
    "cloud_s": Heading("mean t^c", r"$\bar{t}^c$", 5),
    "cloud_predicted_s": Heading("mean p^c", r"$\bar{p}^c$", 5),
    "cloud_residual_s": Heading("cloud res.", r"$\bar{p}^c-\bar{t}^c$", 5),
    "onboard_s": Heading("mean t^l", r"$\bar{t}^l$", 5),
    "onboard_predicted_s": Heading("mean p^l", r"$\bar{p}^l$", 5),
    "onboard_residual_s": Heading("onboard res.", r"$\bar{p}^l-\bar{t}^l$", 5),
    "accuracy_percent": Heading("accuracy %", r"acc. \%", 2),
    "scored": Heading("rows", "rows", 0),
    "cloud_residual_percent": Heading("cloud res. %", r"res.$^c$ \%", 2),
    "onboard_residual_percent": Heading("onboard res. %", r"res.$^l$ \%", 2),
    "cloud_mae_s": Heading("MAE cloud", "MAE$^c$", 5),
    "onboard_mae_s": Heading("MAE onboard", "MAE$^l$", 5),
    "cloud_p95_s": Heading("P95 cloud", "P95$^c$", 5),
    "onboard_p95_s": Heading("P95 onboard", "P95$^l$", 5),
    "time_over_oracle": Heading("time/oracle", "time/oracle", 5),
    "regret_s": Heading("regret s", "regret", 5),
    "regret_mean_s": Heading("regret s/task", "regret/task", 5),
    "cloud_percent": Heading("cloud %", r"cloud \%", 2),
}
FIRST = (  # the most important columns
    "accuracy_percent",
    "time_over_oracle",
    "cloud_s",
    "cloud_predicted_s",
    "onboard_s",
    "onboard_predicted_s",
    "cloud_mae_s",
    "onboard_mae_s",
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

    def picked(self, picks: npt.NDArray[np.intp]) -> "Scored":
        """The rows with these indices, in their shape."""
        onboard, cloud = self.onboard_predicted_s, self.cloud_predicted_s
        return Scored(
            onboard_s=self.onboard_s[picks],
            cloud_s=self.cloud_s[picks],
            to_cloud=self.to_cloud[picks],
            onboard_predicted_s=None if onboard is None else onboard[picks],
            cloud_predicted_s=None if cloud is None else cloud[picks],
        )


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
            found[f"{site}_residual_percent"] = 100 * _divided(residual, true.mean(-1))
            found[f"{site}_mae_s"] = errors.mean(-1)
            found[f"{site}_p95_s"] = quantile(errors, 95)
    return found


def rule_figures(scored: Scored, spent_s: Column | None = None) -> dict[str, Column]:
    """The figures that need no predictions. If the times of a row are equal, both sites are right.

    `spent_s`: what each task took, if it may have been more than the time of its site.
    """
    site_s = np.where(scored.to_cloud, scored.cloud_s, scored.onboard_s)
    spent_s = site_s if spent_s is None else spent_s
    best_s = np.minimum(scored.cloud_s, scored.onboard_s)
    return {
        "cloud_s": scored.cloud_s.mean(-1),
        "onboard_s": scored.onboard_s.mean(-1),
        "accuracy_percent": 100 * (site_s == best_s).mean(-1),
        "time_over_oracle": _divided(spent_s.sum(-1), best_s.sum(-1)),
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
    return _divided(np.where(there, values, 0.0).sum(-1), there.sum(-1).astype(float))


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


def _divided(part: Column, whole: Column) -> Column:
    """`part` / `whole`: NaN if `whole` is 0, infinite if it is nearly 0."""
    with np.errstate(over="ignore"):
        return np.divide(part, whole, out=np.full_like(whole, np.nan), where=whole > 0)
