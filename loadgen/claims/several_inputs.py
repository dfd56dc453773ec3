"""Claim 7: least squares also takes several inputs (n-dimensional regression), if the dataset has them.

Only what is known before a task is an input: what is measured of its site, and the bytes that it sends.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from offboard.loadgen.claims.claim import Claim, claim, mean_of, ratio, unknown
from offboard.loadgen.claims.claims_settings import ClaimsConfig
from offboard.loadgen.claims.prediction_claims import SITES, errors_of, right
from offboard.loadgen.replay.dataset_file import FEATURES
from offboard.loadgen.table.measured_rows import Column, Rows, is_csv, number, read_cells
from offboard.loadgen.table.table_two_figures import Scored
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

CLAIM = 7

Inputs = Mapping[str, Sequence[float | None]]  # the values of each column; None: an empty cell


def several_inputs(read: Inputs | None, rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """All inputs against the size alone, at 80:20: accuracy in points, and the ratio of the mean errors."""
    split = len(rows) * 4 // 5
    inputs = {name: _filled(values) for name, values in (read or {}).items() if _known(values[:split])}
    if read is None:
        why = "only a dataset has inputs: loadgen export RUN --csv FILE"
    elif not 2 <= split < len(rows):
        why = "not enough rows"
    else:
        why = "" if inputs else "only sizes are known in the first 80 % of the rows"
    if why:
        yield unknown(CLAIM, "several inputs", why)
        return
    alone, several = _predicted(rows, split, {}), _predicted(rows, split, inputs)
    blocks = config.blocks(len(rows) - split)
    gain = mean_of(blocks, 100.0 * (right(several) - right(alone)))
    names = ", ".join(inputs)
    yield claim(CLAIM, "several inputs: accuracy points", gain, note=f"the size and {names}")
    for site in SITES:
        if any(name in inputs for name in of_site(site)):
            (error_s, _), (alone_s, _) = errors_of(several, site), errors_of(alone, site)
            yield claim(
                CLAIM, f"several inputs: {site} MAE, ratio", ratio(blocks, abs(error_s), abs(alone_s))
            )


def read_inputs(path: Path) -> Inputs | None:
    """The columns of a dataset that are known before a task; None: it is a trace."""
    if not is_csv(path):
        return None
    names = [name for site in SITES for name in of_site(site)]
    found: dict[str, list[float | None]] = {}
    for where, cells in read_cells(path, names):
        for name in filter(cells.__contains__, names):
            text = cells[name].strip()
            found.setdefault(name, []).append(number(where, name, text) if text else None)
    return found


def of_site(site: str) -> tuple[str, ...]:
    """The columns that may be inputs for the time of one site."""
    sent = (f"{site}_send_bytes",) if site != ONBOARD else ()
    return (*(f"{site}.{name}" for name in FEATURES[site]), *sent)


def _predicted(rows: Rows, split: int, inputs: Mapping[str, Column]) -> Scored:
    """The rows after the split, predicted by least squares on the rows before it."""
    predicted = {}
    for site in SITES:
        columns = [rows.size, *(inputs[name] for name in of_site(site) if name in inputs)]
        sizes = list(zip(*(column.tolist() for column in columns), strict=True))
        line = LeastSquares(split)
        for size, seconds in zip(sizes[:split], getattr(rows, f"{site}_s").tolist(), strict=False):
            line.learn(size, seconds)
        found = [line.predict(size) for size in sizes[split:]]
        predicted[site] = np.array([one.seconds for one in found if one is not None])
    scored = rows.since(split)
    return Scored(
        onboard_s=scored.onboard_s,
        cloud_s=scored.cloud_s,
        to_cloud=predicted[CLOUD] < predicted[ONBOARD],  # Eq. 1; a tie stays onboard
        onboard_predicted_s=predicted[ONBOARD],
        cloud_predicted_s=predicted[CLOUD],
    )


def _known(values: Sequence[float | None]) -> bool:
    return any(one is not None for one in values)


def _filled(values: Sequence[float | None]) -> Column:
    """Each unknown value is the one before; at the start, the first known one."""
    last = next(one for one in values if one is not None)
    filled = []
    for one in values:
        last = last if one is None else one
        filled.append(last)
    return np.array(filled)
