"""Claims 3, 4, 5, 8 and 9: errors and accuracy of least squares, its rivals, and the time that it saves."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.claims.claim import (
    BELOW_ONE,
    POSITIVE,
    Claim,
    Claimed,
    Figure,
    claim,
    mean_of,
    ratio,
    unknown,
)
from offboard.loadgen.claims.claims_settings import ClaimsConfig
from offboard.loadgen.table import published_table_two
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.predictor_evaluation import Evaluation, predict
from offboard.loadgen.table.table_settings import CHOSEN, FULL, FULL_WINDOW
from offboard.loadgen.table.table_two_figures import Score, Scored
from offboard.robot_client.predictors import LEAST_SQUARES
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

ERROR, ACCURACY, RIVALS, K_MEANS, SAVING = 3, 4, 5, 8, 9  # the claims
ERROR_FROM = 41  # rows: the paper's claim is about N > 40
ERROR_MAX = 2.0  # per cent
ENOUGH = "not enough rows"
SITES = (CLOUD, ONBOARD)
PUBLISHED = {score.window: score for score in published_table_two.SCORES}
RIVAL_PERCENTS = {"lstm": published_table_two.LSTM_PERCENT, "lstm-sequence": published_table_two.LSTM_PERCENT}
FOLLOWING = ("lstm-sequence",)  # predict from the rows just before, so they see those after the split, too


class PredictionClaims:
    """The claims that the predictions of one dataset decide."""

    def __init__(self, rows: Rows, config: ClaimsConfig) -> None:
        self._rows = rows
        self._config = config
        self._evaluation = Evaluation(rows, config.of_table())

    def errors(self) -> Iterator[Claim]:
        """The residual for each N > 40 in both feedback modes, and the error of single predictions."""
        for length in self._config.lengths():
            if length < ERROR_FROM:
                continue
            for feedback in (CHOSEN, FULL):
                yield from self._residuals(length, feedback)
        for feedback in (CHOSEN, FULL):
            yield from self._mean_errors(feedback)

    def accuracy(self) -> Iterator[Claim]:
        """The accuracy for each N, and how much it rises from each N to the next one."""
        windows = [*map(str, self._config.lengths())]
        if FULL_WINDOW in self._config.windows:
            windows.append(FULL_WINDOW)
        found = {window: self._scored(window) for window in windows}
        for window, scored in found.items():
            words, theirs = f"accuracy %, N = {window}", _published(window).accuracy_percent
            if scored is None:
                yield unknown(ACCURACY, words, ENOUGH)
                continue
            ours = mean_of(self._config.blocks(len(scored.to_cloud)), 100.0 * right(scored))
            claimed = None if theirs is None else Claimed(low=theirs)
            yield claim(ACCURACY, words, ours, theirs=theirs, claimed=claimed)
        for earlier, later in pairwise(windows):
            before, after = found[earlier], found[later]
            if before is not None and after is not None:
                was, now = _published(earlier).accuracy_percent, _published(later).accuracy_percent
                theirs = None if was is None or now is None else now - was
                words = f"accuracy points, N = {earlier} to {later}"
                yield claim(ACCURACY, words, self._gain(after, before), theirs=theirs, claimed=POSITIVE)

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
        spent_s = np.where(scored.to_cloud, scored.cloud_s, scored.onboard_s)
        blocks = self._config.blocks(len(spent_s))
        for words, other_s, claimed in (
            ("time / always onboard", scored.onboard_s, BELOW_ONE),
            ("time / always cloud", scored.cloud_s, BELOW_ONE),
            ("time / oracle", np.minimum(scored.onboard_s, scored.cloud_s), None),
        ):
            theirs = None if claimed is None else "< 1"
            ours = ratio(blocks, spent_s, other_s)
            yield claim(SAVING, f"{words}, N = {WINDOW}", ours, theirs=theirs, claimed=claimed)

    def _residuals(self, length: int, feedback: str) -> Iterator[Claim]:
        scored = self._scored(str(length), feedback=feedback)
        for site in SITES:
            words = f"{site} residual %, N = {length}, {feedback}"
            if scored is None:
                yield unknown(ERROR, words, ENOUGH)
                continue
            error_s, true_s = errors_of(scored, site)
            ours = ratio(self._config.blocks(len(true_s)), error_s, true_s).times(100)
            score = _published(str(length))
            residual_s, mean_s = getattr(score, f"{site}_residual_s"), getattr(score, f"{site}_s")
            theirs = None if residual_s is None else 100 * residual_s / mean_s
            yield claim(ERROR, words, ours, theirs=theirs, claimed=Claimed(-ERROR_MAX, ERROR_MAX))

    def _mean_errors(self, feedback: str) -> Iterator[Claim]:
        scored = self._scored(str(WINDOW), feedback=feedback)
        for site in SITES:
            words = f"{site} MAE %, N = {WINDOW}, {feedback}"
            if scored is None:
                yield unknown(ERROR, words, ENOUGH)
                continue
            error_s, true_s = errors_of(scored, site)
            ours = ratio(self._config.blocks(len(true_s)), abs(error_s), true_s).times(100)
            yield claim(ERROR, words, ours, claimed=Claimed(high=ERROR_MAX))

    def _scored(self, window: str, name: str = LEAST_SQUARES, feedback: str = CHOSEN) -> Scored | None:
        return self._evaluation.predictions(name, window, feedback)

    def _following(self, name: str) -> Scored:
        """As `full`, but both sites go on to learn; it is not fitted again before the rows end."""
        length = len(self._rows) * 4 // 5
        p_onboard, p_cloud = predict(
            self._rows, length, predictor=name, feedback=FULL, seed=self._config.seed
        )
        rows = self._rows.since(length)
        return Scored(rows.onboard_s, rows.cloud_s, p_cloud < p_onboard)

    def _gain(self, one: Scored, other: Scored) -> Figure:
        """The accuracy of `one` minus that of `other`, in points, on the rows that both scored."""
        count = min(len(one.to_cloud), len(other.to_cloud))
        gain = 100.0 * (right(one)[-count:] - right(other)[-count:])
        return mean_of(self._config.blocks(count), gain)


def right(scored: Scored) -> Column:
    """1 for each row that went to the faster site, otherwise 0. On a tie, either site is right."""
    chosen_s = np.where(scored.to_cloud, scored.cloud_s, scored.onboard_s)
    found: Column = (chosen_s == np.minimum(scored.cloud_s, scored.onboard_s)).astype(np.float64)
    return found


def errors_of(scored: Scored, site: str) -> tuple[Column, Column]:
    """The errors of the predictions of one site, and the true times."""
    true_s: Column = getattr(scored, f"{site}_s")
    predicted_s: Column = getattr(scored, f"{site}_predicted_s")
    return predicted_s - true_s, true_s


def _published(window: str) -> Score:
    """The line of the paper; an empty one if it has none."""
    return PUBLISHED.get(window, Score(LEAST_SQUARES, window))
