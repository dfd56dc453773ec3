"""LSTM: the neural network that the paper compares its method with."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction

try:
    import torch
    from torch import nn
except ImportError as error:
    raise MissingExtra("predictor lstm", "lstm") from error

# The paper gives these two values. It trained on the first 80 % of 1,000 rows.
LAYERS = 4
BATCH = 50
# The other values were chosen on lines, curves and steps with and without noise, for 5 to 800 observations.
WIDTH = 32
RATE = 0.01  # of Adam
UPDATES_MAX = 800  # updates of the weights in one fit: 53 epochs of 800 observations
CHECK_EVERY = 5  # updates
PATIENCE = 150  # the fit ends after this many updates without a better check
BETTER = 0.999  # a check is better if its loss is below this share of the best one
HELD_OUT_SHARE = 10  # the newest tenth decides when to stop ...
HELD_OUT_MIN = 2  # ... unless that is fewer than this; then all observations train and decide
REFIT_SHARE = 2  # training continues after half as many observations as the last fit had
FLAT = 1e-9  # times that differ by less than this share are equal
SCORE_MAX = 1e30  # larger scores would overflow 32 bits; all cells are saturated long before
COMPUTING = threading.Lock()  # the number of threads of torch is changed for the whole process, and restored


class Lstm(Refitted):
    """Four stacked LSTM layers and a linear one, trained on the window with mean square error.

    The input is the size of the task, as a sequence of length 1. A robot never learns what the other site
    would have taken, so there is no complete sequence. Each cell starts from zero, so its recurrent weights
    and its forget gate have no effect.
    Size and seconds are standardised. Beyond the observed sizes the cells saturate, so the prediction
    approaches a constant instead of following a line.
    After half as many observations as the last fit had, training continues from the present weights. A fit
    takes about a second, so this predictor is meant for tables rather than for a working robot.
    The spread is the standard deviation of the residuals over the window, which are mostly training errors.
    """

    def __init__(self, window: int, seed: int = 0) -> None:
        super().__init__(window, REFIT_SHARE)
        self._random = torch.Generator("cpu").manual_seed(seed)
        self._network = _Network(self._random)

    def _fit(self, sizes: Column, seconds: Column) -> None:
        self._size, self._size_scale = float(sizes.mean()), float(sizes.std())
        self._seconds, self._seconds_scale = float(seconds.mean()), float(seconds.std())
        if np.ptp(sizes) <= SIZE_MIN:
            self._size_scale = math.inf  # every size scores 0
        self._flat = self._seconds_scale <= FLAT * float(seconds.max())
        self._spread = self._seconds_scale if len(seconds) > 1 else None
        if self._flat:
            return
        with _alone(), torch.enable_grad():
            x = _column((sizes - self._size) / self._size_scale)
            y = _column((seconds - self._seconds) / self._seconds_scale)
            left = self._network.train(x, y, self._random)
        self._spread = self._seconds_scale * left

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - not a time series
        if self._flat:
            return Prediction(self._seconds, self._spread)
        score = (size - self._size) / self._size_scale
        with _alone(), torch.no_grad():
            found = self._network(_column(np.array([min(max(score, -SCORE_MAX), SCORE_MAX)])))
        return Prediction(self._seconds + self._seconds_scale * found.item(), self._spread)


class _Network:
    """The network. `random` draws its first weights; input and output have the shape (1, observations, 1)."""

    def __init__(self, random: torch.Generator) -> None:
        with torch.inference_mode(False), torch.no_grad():
            # Created without values, because torch would draw them from its global generator.
            self._cells = nn.LSTM(1, WIDTH, LAYERS, device="meta", dtype=torch.float32).to_empty(device="cpu")
            self._out = nn.Linear(WIDTH, 1, device="meta", dtype=torch.float32).to_empty(device="cpu")
            bound = 1 / math.sqrt(WIDTH)  # as in torch
            for weights in self._weights():
                weights.uniform_(-bound, bound, generator=random)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return self._out(self._cells(x)[0])

    def train(self, x: torch.Tensor, y: torch.Tensor, random: torch.Generator) -> float:
        """Continue training; return the root mean square error on all of x."""
        held_out = x.shape[1] // HELD_OUT_SHARE
        trained = x.shape[1] - held_out if held_out >= HELD_OUT_MIN else x.shape[1]
        checked = slice(trained % x.shape[1], None)
        best, best_at, best_weights = self._error(x[:, checked], y[:, checked]), 0, self._copy()
        optimiser = torch.optim.Adam(self._weights(), lr=RATE)
        for update, rows in enumerate(islice(_batches(trained, random), UPDATES_MAX), start=1):
            optimiser.zero_grad()
            nn.functional.mse_loss(self(x[:, rows]), y[:, rows]).backward()
            optimiser.step()
            if update % CHECK_EVERY:
                continue
            error = self._error(x[:, checked], y[:, checked])
            if error < BETTER * best:
                best, best_at, best_weights = error, update, self._copy()
            elif update - best_at >= PATIENCE:
                break
        optimiser.zero_grad()
        with torch.no_grad():
            for weights, values in zip(self._weights(), best_weights, strict=True):
                weights.copy_(values)
        return math.sqrt(self._error(x, y))

    def _error(self, x: torch.Tensor, y: torch.Tensor) -> float:
        with torch.no_grad():
            return float(nn.functional.mse_loss(self(x), y))

    def _weights(self) -> list[torch.Tensor]:
        return [*self._cells.parameters(), *self._out.parameters()]

    def _copy(self) -> list[torch.Tensor]:
        return [weights.detach().clone() for weights in self._weights()]


@contextmanager
def _alone() -> Iterator[None]:
    """Run torch on one thread, outside of the inference mode that the caller may be in.

    The work is too small for several threads: on a busy machine they waited for each other for most of a
    minute.
    """
    with COMPUTING:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with torch.inference_mode(False):
                yield
        finally:
            torch.set_num_threads(threads)


def _batches(count: int, random: torch.Generator) -> Iterator[torch.Tensor]:
    """Endless batches of BATCH indices below `count`; each index comes once before any comes again."""
    while True:
        yield from torch.randperm(count, generator=random, device="cpu").split(BATCH)


def _column(scores: Column) -> torch.Tensor:
    return torch.from_numpy(scores.astype(np.float32)).reshape(1, -1, 1)
