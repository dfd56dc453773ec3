"""Predictors by name; one family a file, loaded when it is asked for."""

import importlib
from dataclasses import dataclass

from offboard.common.errors import ConfigError
from offboard.robot_client.predictors.base import Prediction, Predictor

__all__ = ["LEAST_SQUARES", "Prediction", "Predictor", "check_name", "make", "names", "slow"]

LEAST_SQUARES = "least-squares"
AVERAGE = "average"
FEATURES = "features:"  # before a name: with the measured features taken out
RIVER = "river:"
WORK = "work:"  # before a name: times per work, where a kind tells its work


@dataclass(frozen=True, slots=True)
class _Entry:
    """Where a predictor is; `slow`: fitting takes so long that `loadgen table` does so once unless told."""

    module: str
    name: str
    slow: bool = False


_ENTRIES: dict[str, _Entry] = {
    LEAST_SQUARES: _Entry("least_squares", "LeastSquares"),
    "recursive-least-squares": _Entry("least_squares", "RecursiveLeastSquares"),
    "clipped-least-squares": _Entry("adaptive", "ClippedLeastSquares"),
    "bayesian-least-squares": _Entry("adaptive", "BayesianLeastSquares"),
    "kalman": _Entry("adaptive", "Kalman"),
    "blind-average": _Entry("average", "blind_average"),
    AVERAGE: _Entry("average", "Average"),
    "theil-sen": _Entry("robust", "TheilSen"),
    "huber": _Entry("robust", "Huber"),
    "random-forest": _Entry("random_forest", "RandomForest", slow=True),
    "arima": _Entry("arima", "Arima", slow=True),
    "sarima": _Entry("arima", "Sarima", slow=True),
    "lstm": _Entry("lstm", "Lstm", slow=True),
}
HELP = f"{', '.join(_ENTRIES)}, or {RIVER}MODULE.CLASS; {FEATURES}NAME: on measured features"  # for --help


def make(name: str, window: int, seed: int = 0) -> Predictor:
    """A fresh predictor that remembers the last `window` executions; the same seed gives the same answers.

    MissingExtra where its library is not installed.
    """
    check_name(name)
    name = name.removeprefix(WORK)
    if name.startswith(FEATURES):
        from offboard.robot_client.predictors.features import Measured

        return Measured(make(name.removeprefix(FEATURES), window, seed))
    if name.startswith(RIVER):
        from offboard.robot_client.predictors.river_model import River

        return River(name.removeprefix(RIVER), window, seed)
    entry = _ENTRIES[name]
    module = importlib.import_module(f"offboard.robot_client.predictors.{entry.module}")
    made: Predictor = getattr(module, entry.name)(window, seed=seed)
    return made


def conditional(name: str) -> bool:
    """Whether it asks for what is measured of a site."""
    return name.startswith(FEATURES) or name in (AVERAGE, "blind-average")


def names() -> tuple[str, ...]:
    """All but those of river, which has its own."""
    return tuple(_ENTRIES)


def slow(name: str) -> bool:
    """Whether one fit takes tenths of a second or more."""
    return name in _ENTRIES and _ENTRIES[name].slow


def check_name(name: str, where: str = "predictor") -> None:
    """ConfigError, naming `where` it stood, unless `make` knows it; nothing is loaded."""
    plain = name.removeprefix(WORK).removeprefix(FEATURES)
    if plain not in _ENTRIES and not plain.startswith(RIVER):
        raise ConfigError(f"{where}: {name!r} is not one of {HELP}")
