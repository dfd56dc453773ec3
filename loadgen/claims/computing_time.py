"""Claim 13: least squares needs less time than the other predictors to be trained and to predict."""

import statistics
import time
from collections.abc import Callable, Iterator

from offboard.common.errors import MissingExtra
from offboard.loadgen import rivals
from offboard.loadgen.claims.claim import ABOVE_ONE, Claim, ClaimsConfig, Figure, claim, unknown
from offboard.loadgen.table.measured_rows import Rows
from offboard.robot_client.predictors import LEAST_SQUARES, Model
from offboard.robot_client.predictors.base import Call, Run
from offboard.robot_client.predictors.plain import model_of

CLAIM = 13
# The median of six rounds lies between the least and the greatest with a probability of 1 - 2 / 2^6 = 97 %.
ROUNDS = 6
TRAINING, PREDICTION = "training", "prediction"
CLAIMED = ("lstm", "lstm-sequence")  # the paper compares itself only with an LSTM


def computing_time(
    rows: Rows, config: ClaimsConfig, step: Callable[[], object] = lambda: None
) -> Iterator[Claim]:
    """The times of each predictor as multiples of those of least squares.

    Training is to learn the first 80 % of the onboard times and to make the first prediction, because most
    predictors fit when they are asked. In each round every predictor has its turn, so that a slow minute of
    the machine counts for all. It is CPU time, so that other programs do not count. `step` is called after
    each of the ROUNDS + 1 rounds.
    """
    split = len(rows) * 4 // 5
    if not 2 <= split < len(rows):
        yield unknown(CLAIM, "computing time", "not enough rows")
        return
    times, missing = measured(rows, split, config, step)
    line = times[LEAST_SQUARES]
    for part, taken_s in line.items():
        yield claim(CLAIM, f"{LEAST_SQUARES}: {part}, ms", _median([1e3 * one for one in taken_s]))
    for name in config.rivals():
        if name in missing:
            yield unknown(CLAIM, f"{name}: times", missing[name])
            continue
        theirs, claimed = ("> 1", ABOVE_ONE) if name in CLAIMED else (None, None)
        for part, taken_s in times[name].items():
            if not all(line[part]):
                yield unknown(CLAIM, f"{part}, {name}", "the CPU clock is too coarse")
                continue
            ratios = [one / other for one, other in zip(taken_s, line[part], strict=True)]
            yield claim(CLAIM, f"{part}, {name}", _median(ratios), theirs=theirs, claimed=claimed)


def measured(
    rows: Rows, split: int, config: ClaimsConfig, step: Callable[[], object]
) -> tuple[dict[str, dict[str, list[float]]], dict[str, str]]:
    """The seconds of each predictor in each round, for all training and for one prediction.

    Also why the others could not be made. The first round does not count.
    """
    times: dict[str, dict[str, list[float]]] = {}
    missing: dict[str, str] = {}
    for turn in range(ROUNDS + 1):
        for name in (LEAST_SQUARES, *config.rivals()):
            if name in missing:
                continue
            try:
                model = model_of(rivals.make(name, split, config.seed), remote=False)
            except MissingExtra as error:
                missing[name] = str(error)
                continue
            training_s, prediction_s = _timed(model, rows, split)
            if turn:
                times[name][TRAINING].append(training_s)
                times[name][PREDICTION].append(prediction_s)
            else:
                times[name] = {TRAINING: [], PREDICTION: []}
        step()
    return times, missing


def _timed(model: Model, rows: Rows, split: int) -> tuple[float, float]:
    """The seconds of training, and of one prediction: the mean over the rows after the split."""
    sizes, seconds = rows.size.tolist(), rows.onboard_s.tolist()
    began = time.process_time()
    for size, second in zip(sizes[:split], seconds[:split], strict=True):
        model.learn(Call(size), Run(second))
    model.predict(Call(sizes[split]))
    trained = time.process_time()
    for size in sizes[split:]:
        model.predict(Call(size))
    return trained - began, (time.process_time() - trained) / (len(sizes) - split)


def _median(values: list[float]) -> Figure:
    return Figure(statistics.median(values), min(values), max(values))
