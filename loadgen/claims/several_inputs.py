"""Claim 7: least squares also takes several inputs (n-dimensional regression), if the dataset has them.

Only what is known before a task is an input: what is measured of its site, and the bytes that it sends.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from offboard.common.errors import DataError
from offboard.loadgen.claims.claim import Claim, claim, mean_of, ratio, unknown
from offboard.loadgen.claims.claims_settings import ClaimsConfig
from offboard.loadgen.claims.prediction_claims import SITES, errors_of, right
from offboard.loadgen.table.measured_rows import Column, Rows, is_csv
from offboard.loadgen.table.table_two_figures import Scored
from offboard.robot_client.predictors.least_squares import LeastSquares

CLAIM = 7
SENT = "_send_bytes"  # after the name of a site: what a task would send there


def several_inputs(path: Path, rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """All inputs against the size alone, at 80:20: accuracy in points, and the ratio of the mean errors."""
    inputs = read_inputs(path) if is_csv(path) else {}
    split = len(rows) * 4 // 5
    if not inputs or not 2 <= split < len(rows):
        yield unknown(CLAIM, "several inputs", "the file has only sizes" if not inputs else "not enough rows")
        return
    alone, several = _predicted(rows, split, {}), _predicted(rows, split, inputs)
    blocks = config.blocks(len(rows) - split)
    gain = mean_of(blocks, 100.0 * (right(several) - right(alone)))
    names = ", ".join(inputs)
    yield claim(CLAIM, "several inputs: accuracy points", gain, note=f"the size and {names}")
    for site in SITES:
        if of_site(inputs, site):
            (error_s, _), (alone_s, _) = errors_of(several, site), errors_of(alone, site)
            yield claim(
                CLAIM, f"several inputs: {site} MAE, ratio", ratio(blocks, abs(error_s), abs(alone_s))
            )


def read_inputs(path: Path) -> dict[str, Column]:
    """The columns of a dataset that are known before a task, without those that have an empty cell."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader)]
        places = {name: at for at, name in enumerate(header) if any(of_site([name], site) for site in SITES)}
        lines = [(reader.line_num, cells) for cells in reader if cells]
    return {
        name: np.array([_number(f"{path}:{line}: {name}", cells[at]) for line, cells in lines])
        for name, at in places.items()
        if all(cells[at].strip() for _, cells in lines)
    }


def of_site(names: Iterator[str] | Sequence[str] | Mapping[str, object], site: str) -> list[str]:
    """The inputs among these columns that say something about one site."""
    return [name for name in names if name.startswith(f"{site}.") or name == f"{site}{SENT}"]


def _predicted(rows: Rows, split: int, inputs: Mapping[str, Column]) -> Scored:
    """The rows after the split, predicted by least squares on the rows before it."""
    predicted = {}
    for site in SITES:
        columns = [rows.size, *(inputs[name] for name in of_site(inputs, site))]
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
        to_cloud=predicted["cloud"] < predicted["onboard"],  # Eq. 1; a tie stays onboard
        onboard_predicted_s=predicted["onboard"],
        cloud_predicted_s=predicted["cloud"],
    )


def _number(where: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number < np.inf:
        raise DataError(f"{where}: {text!r} is not a finite number from 0 up")
    return number
