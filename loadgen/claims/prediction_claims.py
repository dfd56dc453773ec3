"""Claims 7 to 12 and 15 to 17: errors and accuracy of least squares, its rivals, and the time that it saves.

Claim 15 is that least squares also takes several inputs (n-dimensional regression), if the dataset has them.
Only what is known before a task is an input: what is measured of its site, and the bytes that it sends.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.claims.claim import (
    BELOW_ONE,
    POSITIVE,
    Claim,
    Claimed,
    ClaimsConfig,
    Figure,
    claim,
    mean_of,
    ratio,
    unknown,
)
from offboard.loadgen.replay.dataset_file import FEATURES
from offboard.loadgen.table.measured_rows import Column, Rows, is_csv, number, read_cells
from offboard.loadgen.table.table_settings import CHOSEN, FULL, FULL_WINDOW
from offboard.loadgen.table.table_two import Evaluation, predict
from offboard.loadgen.table.table_two_figures import LSTM_PERCENT, PUBLISHED, Score, Scored, Sides
from offboard.robot_client.predictors import LEAST_SQUARES
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

SHORT_ERROR, ERROR, ACCURACY, MARGINAL, ALL_DATA, RIVALS = 7, 8, 9, 10, 11, 12  # the claims
INPUTS, K_MEANS, SAVING = 15, 16, 17
ERROR_FROM = 41  # rows: the paper's claim is about N > 40
ERROR_MAX = 2.0  # per cent
SHORT_MAX = 20  # rows of the windows whose errors the paper prints to show that they are too short
GAIN_MAX = 4.0  # points of a gain that is marginal; from N = 50 to 500, the paper gains 3.1
RESIDUAL, MAE = "residual", "MAE"
ENOUGH = "not enough rows"
SITES = (CLOUD, ONBOARD)
RIVAL_PERCENTS = {"lstm": LSTM_PERCENT, "lstm-sequence": LSTM_PERCENT}
FOLLOWING = ("lstm-sequence",)  # predict from the rows just before, so they see those after the split, too

Inputs = Mapping[str, Sequence[float | None]]  # the values of each column; None: an empty cell


class PredictionClaims:
    """The claims that the predictions of one dataset decide."""

    def __init__(self, rows: Rows, config: ClaimsConfig) -> None:
        self._rows = rows
        self._config = config
        self._evaluation = Evaluation(rows, config.of_table())

    def errors(self) -> Iterator[Claim]:
        """The residual for short windows; that for each N > 40 and the mean error, in both feedback modes."""
        for length in self._config.lengths():
            if length <= SHORT_MAX:
                yield from self._errors(RESIDUAL, length, CHOSEN)
        for length in self._config.lengths():
            if length < ERROR_FROM:
                continue
            for feedback in (CHOSEN, FULL):
                yield from self._errors(RESIDUAL, length, feedback)
        for feedback in (CHOSEN, FULL):
            yield from self._errors(MAE, WINDOW, feedback)

    def accuracy(self) -> Iterator[Claim]:
        """The accuracy for each N, and how much it rises from each N to the next one."""
        windows = [*map(str, self._config.lengths())]
        if FULL_WINDOW in self._config.windows:
            windows.append(FULL_WINDOW)
        found = {window: self._scored(window) for window in windows}
        for window, scored in found.items():
            words, theirs = f"accuracy %, N = {window}", _published(window).accuracy_percent
            number = ALL_DATA if window == FULL_WINDOW else ACCURACY
            if scored is None:
                yield unknown(number, words, ENOUGH)
                continue
            ours = mean_of(self._config.blocks(len(scored.to_cloud)), np.where(scored.right, 100.0, 0.0))
            claimed = None if theirs is None else Claimed(low=theirs)
            yield claim(number, words, ours, theirs=theirs, claimed=claimed)
        for earlier, later in pairwise(windows):
            before, after = found[earlier], found[later]
            if before is not None and after is not None:
                was, now = _published(earlier).accuracy_percent, _published(later).accuracy_percent
                theirs = None if was is None or now is None else now - was
                words = f"accuracy points, N = {earlier} to {later}"
                number, claimed = _gained(earlier, later)
                yield claim(number, words, self._gain(after, before), theirs=theirs, claimed=claimed)

    def rival(self, name: str) -> Claim:
        """How many points the accuracy of least squares is above that of another predictor, at 80:20."""
        number = K_MEANS if name == "k-means" else RIVALS
        words, theirs = f"ahead of {name}", None
        line = self._scored(FULL_WINDOW)
        if line is None:
            return unknown(number, words, ENOUGH)
        try:
            other = self._following(name) if name in FOLLOWING else self._scored(FULL_WINDOW, name)
        except MissingExtra as error:
            return unknown(number, words, str(error))
        assert other is not None, "it has as many rows as least squares"
        if name in RIVAL_PERCENTS:
            theirs = (PUBLISHED[FULL_WINDOW].accuracy_percent or 0.0) - RIVAL_PERCENTS[name]
        claimed = None if theirs is None else POSITIVE
        return claim(number, words, self._gain(line, other), theirs=theirs, claimed=claimed)

    def saving(self) -> Iterator[Claim]:
        """The time with least squares as a share of the time on one site only, and of the best time."""
        scored = self._scored(str(WINDOW))
        if scored is None:
            yield unknown(SAVING, "time", ENOUGH)
            return
        blocks = self._config.blocks(len(scored.to_cloud))
        for words, other_s, claimed in (
            ("time / always onboard", scored.onboard_s, BELOW_ONE),
            ("time / always cloud", scored.cloud_s, BELOW_ONE),
            ("time / oracle", scored.best_s, None),
        ):
            theirs = None if claimed is None else "< 1"
            ours = ratio(blocks, scored.spent_s, other_s)
            yield claim(SAVING, f"{words}, N = {WINDOW}", ours, theirs=theirs, claimed=claimed)

    def _errors(self, measure: str, length: int, feedback: str) -> Iterator[Claim]:
        scored = self._scored(str(length), feedback=feedback)
        number = SHORT_ERROR if length <= SHORT_MAX else ERROR
        for site in SITES:
            words = f"{site} {measure} %, N = {length}, {feedback}"
            if scored is None:
                yield unknown(number, words, ENOUGH)
                continue
            error_s, true_s = errors_of(scored, site)
            theirs: float | None = None
            claimed: Claimed | None = Claimed(high=ERROR_MAX)
            if measure == MAE:
                error_s = abs(error_s)
            else:
                theirs = _published_residual(length, site)
                most = ERROR_MAX if number == ERROR else theirs and abs(theirs)
                claimed = None if most is None else Claimed(-most, most)
            ours = ratio(self._config.blocks(len(true_s)), error_s, true_s).times(100)
            yield claim(number, words, ours, theirs=theirs, claimed=claimed)

    def _scored(self, window: str, name: str = LEAST_SQUARES, feedback: str = CHOSEN) -> Scored | None:
        return self._evaluation.predictions(name, window, feedback)

    def _following(self, name: str) -> Scored:
        """As `full`, but both sites go on to learn; it is not fitted again before the rows end."""
        length = len(self._rows) * 4 // 5
        predicted = predict(self._rows, length, predictor=name, feedback=FULL, seed=self._config.seed)
        return Scored.predicted(self._rows.since(length), *predicted)

    def _gain(self, one: Scored, other: Scored) -> Figure:
        """The accuracy of `one` minus that of `other`, in points, on the rows that both scored."""
        count = min(len(one.to_cloud), len(other.to_cloud))
        return mean_of(self._config.blocks(count), _points(one.right[-count:], other.right[-count:]))


def several_inputs(read: Inputs | None, rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """All inputs against the size alone, at 80:20: accuracy in points, and the ratio of the mean errors."""
    split = len(rows) * 4 // 5
    inputs = {
        name: _filled(values)
        for name, values in (read or {}).items()
        if any(one is not None for one in values[:split])
    }
    if read is None:
        why = "only a dataset has inputs: loadgen export RUN --csv FILE"
    elif not 2 <= split < len(rows):
        why = ENOUGH
    else:
        why = "" if inputs else "only sizes are known in the first 80 % of the rows"
    if why:
        yield unknown(INPUTS, "several inputs", why)
        return
    alone, several = _predicted(rows, split, {}), _predicted(rows, split, inputs)
    blocks = config.blocks(len(rows) - split)
    gain = mean_of(blocks, _points(several.right, alone.right))
    names = ", ".join(inputs)
    yield claim(INPUTS, "several inputs: accuracy points", gain, note=f"the size and {names}")
    for site in SITES:
        if any(name in inputs for name in of_site(site)):
            (error_s, _), (alone_s, _) = errors_of(several, site), errors_of(alone, site)
            ours = ratio(blocks, abs(error_s), abs(alone_s))
            yield claim(INPUTS, f"several inputs: {site} MAE, ratio", ours)


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
    return Scored.predicted(rows.since(split), predicted[ONBOARD], predicted[CLOUD])


def _filled(values: Sequence[float | None]) -> Column:
    """Each unknown value is the one before; at the start, the first known one."""
    last = next(one for one in values if one is not None)
    filled = []
    for one in values:
        last = last if one is None else one
        filled.append(last)
    return np.array(filled)


def errors_of(scored: Scored, site: str) -> tuple[Column, Column]:
    """The errors of the predictions of one site, and the true times."""
    true_s: Column = getattr(scored, f"{site}_s")
    predicted_s: Column = getattr(scored, f"{site}_predicted_s")
    return predicted_s - true_s, true_s


def _points(right: Sides, others: Sides) -> Column:
    """How many points of accuracy each row brings: 100, 0 or -100."""
    found: Column = 100.0 * (right.astype(np.float64) - others)
    return found


def _gained(earlier: str, later: str) -> tuple[int, Claimed]:
    """The claim about the gain between two windows, and its limits."""
    if later == FULL_WINDOW:
        return ALL_DATA, POSITIVE
    return (MARGINAL, Claimed(high=GAIN_MAX)) if int(earlier) >= WINDOW else (ACCURACY, POSITIVE)


def _published(window: str) -> Score:
    """The line of the paper; an empty one if it has none."""
    return PUBLISHED.get(window, Score(LEAST_SQUARES, window))


def _published_residual(length: int, site: str) -> float | None:
    """In per cent of the mean time."""
    score = _published(str(length))
    residual_s, mean_s = getattr(score, f"{site}_residual_s"), getattr(score, f"{site}_s")
    return None if residual_s is None else 100 * residual_s / mean_s
