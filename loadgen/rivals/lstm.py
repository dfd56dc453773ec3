"""LSTM: the neural network that the paper compares its method with, on single sizes and on sequences."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from offboard.common.errors import MissingExtra
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction

try:
    import torch
    from torch import nn
except ImportError as error:
    raise MissingExtra("predictor lstm or lstm-sequence", "lstm") from error

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
PREVIOUS = 5  # observations before the task in a sequence; two or ten were no better on measured datasets
FLAT = 1e-9  # times that differ by less than this share are equal
SCORE_MAX = 1e30  # larger scores would overflow 32 bits; all cells are saturated long before
COMPUTING = threading.Lock()  # the number of threads of torch is changed for the whole process, and restored

Sequences = npt.NDArray[np.float64]  # steps x observations x numbers


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

    refit_share = 2
    previous = 0  # observations before the task that are part of its sequence
    numbers = 1  # in each step

    def __init__(self, window: int, seed: int = 0) -> None:
        super().__init__(window, seed)
        self._random = torch.Generator("cpu").manual_seed(seed)
        self._network = _Network(self.numbers, self._random)

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
            x = _tensor(self._sequences(self._size_scores(sizes), self._time_scores(seconds)))
            y = _tensor(self._time_scores(seconds)[np.newaxis, :, np.newaxis])
            left = self._network.train(x, y, self._random)
        self._spread = self._seconds_scale * left

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - it counts no tasks
        if self._flat:
            return Prediction(self._seconds, self._spread)
        newest = list(islice(reversed(self._observations), self.previous))[::-1]
        sizes, seconds = np.array([*newest, (size, self._seconds)]).T
        x = self._sequences(self._size_scores(sizes), self._time_scores(seconds))[:, -1:]
        with _alone(), torch.no_grad():
            found = self._network(_tensor(x))
        return Prediction(self._seconds + self._seconds_scale * found.item(), self._spread)

    def _sequences(self, sizes: Column, seconds: Column) -> Sequences:  # noqa: ARG002 - sizes only
        """The sequence of each task, oldest step first."""
        return sizes[np.newaxis, :, np.newaxis]

    def _size_scores(self, sizes: Column) -> Column:
        return np.clip((sizes - self._size) / self._size_scale, -SCORE_MAX, SCORE_MAX)

    def _time_scores(self, seconds: Column) -> Column:
        return np.clip((seconds - self._seconds) / self._seconds_scale, -SCORE_MAX, SCORE_MAX)


class LstmSequence(Lstm):
    """The same network on sequences: the last PREVIOUS observations of the site, then the task itself.

    Each step holds a size and its time; the time of the task itself is unknown, so its step holds the mean.
    Missing steps before the first observation hold the means of both. So it can follow a load that lasts for
    several tasks, which `Lstm` cannot see.
    """

    previous = PREVIOUS
    numbers = 2

    def _sequences(self, sizes: Column, seconds: Column) -> Sequences:
        observed = np.stack([sizes, seconds], axis=-1)
        padded = np.concatenate([np.zeros((self.previous, 2)), observed])
        before = sliding_window_view(padded, self.previous, axis=0)[: len(sizes)]  # tasks x numbers x steps
        task = np.stack([sizes, np.zeros(len(sizes))], axis=-1)
        return np.concatenate([before.transpose(2, 0, 1), task[np.newaxis]])


class _Network:
    """The network. `random` draws its first weights.

    The input has the shape (steps, observations, numbers), the output (1, observations, 1).
    """

    def __init__(self, numbers: int, random: torch.Generator) -> None:
        with torch.inference_mode(False), torch.no_grad():
            # Created without values, because torch would draw them from its global generator.
            cells = nn.LSTM(numbers, WIDTH, LAYERS, device="meta", dtype=torch.float32)
            self._cells = cells.to_empty(device="cpu")
            self._out = nn.Linear(WIDTH, 1, device="meta", dtype=torch.float32).to_empty(device="cpu")
            bound = 1 / math.sqrt(WIDTH)  # as in torch
            for weights in self._weights():
                weights.uniform_(-bound, bound, generator=random)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return self._out(self._cells(x)[0][-1:])

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


def _tensor(scores: Sequences) -> torch.Tensor:
    return torch.from_numpy(scores.astype(np.float32))
