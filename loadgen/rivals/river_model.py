"""Any regressor of the library river. It learns one observation at a time, and decides what it forgets."""

import difflib
import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable
from functools import partial

from offboard.common.errors import ConfigError, MissingExtra, describe
from offboard.robot_client.predictors.base import Prediction, check_observation
from offboard.robot_client.predictors.window import checked_length

try:
    import river
    from river.base import Regressor
except ImportError as error:
    raise MissingExtra("predictor river", "river") from error

# A model must be able to learn these standard scores of size and seconds.
TRIAL = ((-1.0, -1.0), (0.0, 0.5), (1.0, 1.0))


class River:
    """The regressor at `path` in river, such as `tree.HoeffdingTreeRegressor`, on the size.

    The window says when warm-up is over, and how long the spread remembers. The model itself decides what it
    forgets and how much memory it uses.
    The model learns standard scores of all sizes and seconds so far. Tasks of 5 ms and of 50 s are then the
    same to it, gradients do not explode, and the line of a model without an intercept passes through both
    means.
    The prediction is the mean of seconds while the model has no answer, or none that is a finite number.
    The spread is the root mean square of the errors on observations that were still unknown. Old errors lose
    weight over the window.
    """

    def __init__(self, path: str, window: int, seed: int = 0) -> None:
        self.path = path
        self.window = checked_length(window)
        self._model = load(path, seed)
        self._seen = 0
        self._size = _Scale()
        self._seconds = _Scale()
        self._square_error: float | None = None

    @property
    def full(self) -> bool:
        return self._seen >= self.window

    def __len__(self) -> int:
        return min(self._seen, self.window)

    def learn(self, size: float, seconds: float) -> None:
        check_observation(size, seconds)
        if self._seen:
            self._learn_error(seconds - self._expected(size))
        self._seen += 1
        self._size.add(size)
        self._seconds.add(seconds)
        self._model.learn_one({"size": self._size.score(size)}, self._seconds.score(seconds))

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002 - not a time series
        if not self._seen:
            return None
        spread = None if self._square_error is None else math.sqrt(self._square_error)
        return Prediction(self._expected(size), spread)

    def _expected(self, size: float) -> float:
        score = self._model.predict_one({"size": self._size.score(size)})
        if score is None or not math.isfinite(score):
            return self._seconds.mean
        return self._seconds.mean + float(score) * self._seconds.deviation

    def _learn_error(self, error: float) -> None:
        square = error * error
        if self._square_error is None:
            self._square_error = square
        else:
            self._square_error += (square - self._square_error) / min(self._seen, self.window)


class _Scale:
    """Mean and standard deviation of all values so far, after Welford (1962)."""

    def __init__(self) -> None:
        self.mean = 0.0
        self._count = 0
        self._squares = 0.0

    @property
    def deviation(self) -> float:
        return math.sqrt(self._squares / self._count) if self._count else 0.0

    def add(self, value: float) -> None:
        self._count += 1
        before = value - self.mean
        self.mean += before / self._count
        self._squares += before * (value - self.mean)

    def score(self, value: float) -> float:
        """In standard deviations from the mean; 0 while all values were equal."""
        deviation = self.deviation
        return (value - self.mean) / deviation if deviation > 0 else 0.0


def __getattr__(name: str) -> Callable[..., River]:
    """PACKAGE__CLASS is a predictor with that regressor of river, so that it has a path as others have."""
    package, both, regressor = name.partition("__")
    if not (package and both and regressor):
        raise AttributeError(name)
    return partial(River, f"{package}.{regressor}")


def load(path: str, seed: int) -> Regressor:
    """A new model; ConfigError unless `path` is PACKAGE.CLASS of a regressor that can learn from sizes."""
    package, _, name = path.partition(".")
    found = _regressors(package).get(name)
    if found is None:
        near = difflib.get_close_matches(path, known()) or known()
        raise ConfigError(
            f"predictor {f'river:{path}'!r} is no regressor of river, such as {', '.join(near)}"
        )
    fault = _fault(found)
    if fault:
        raise ConfigError(f"predictor 'river:{path}' {fault}, unlike {', '.join(known())}")
    return _new(found, seed)


def known() -> list[str]:
    """All paths that `load` accepts. This imports all of river."""
    return [
        f"{package}.{name}"
        for package in _packages()
        for name, found in _regressors(package).items()
        if not _fault(found)
    ]


def _packages() -> list[str]:
    return [module.name for module in pkgutil.iter_modules(river.__path__)]


def _regressors(package: str) -> dict[str, type[Regressor]]:
    """The public regressors of a package of river, by name. Imports nothing outside of river."""
    if package not in _packages():
        return {}
    public = vars(importlib.import_module(f"river.{package}"))
    return {
        name: found
        for name, found in public.items()
        if inspect.isclass(found) and issubclass(found, Regressor) and not inspect.isabstract(found)
    }


def _fault(found: type[Regressor]) -> str | None:
    """Why a regressor cannot be used here, as a phrase after its name; None if it can."""
    needed = [
        parameter.name
        for parameter in inspect.signature(found).parameters.values()
        if parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]
    if needed:
        return f"cannot be made without {' and '.join(needed)}"
    try:
        model = _new(found, seed=0)
        for size, seconds in TRIAL:
            model.learn_one({"size": size}, seconds)
        float(model.predict_one({"size": 0.5}) or 0.0)
    except Exception as error:  # noqa: BLE001 - a model for other data may raise anything
        return f"does not learn one number from another ({describe(error)})"
    return None


def _new(found: type[Regressor], seed: int) -> Regressor:
    return found(seed=seed) if "seed" in inspect.signature(found).parameters else found()
