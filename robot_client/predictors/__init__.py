"""The registry of predictors: their names, and what each name stands for.

A family of predictors has a file of its own, which is loaded when one of its names is asked for.
"""

import importlib
from dataclasses import dataclass

from offboard.common.errors import ConfigError
from offboard.robot_client.predictors.base import Prediction, Predictor

__all__ = ["LEAST_SQUARES", "PARTS", "Prediction", "Predictor", "check_name", "make", "names", "slow"]

LEAST_SQUARES = "least-squares"
PARTS = "parts"
_CLASS = "MODULE.CLASS"


@dataclass(frozen=True, slots=True)
class _Entry:
    """What one name stands for.

    module, factory: where the predictor is made.
    follows: what stands after the name and a colon, if anything: a class of river.
    slow: one fit takes tenths of a second or more.
    """

    module: str
    factory: str
    follows: str = ""
    slow: bool = False


_ENTRIES: dict[str, _Entry] = {
    LEAST_SQUARES: _Entry("least_squares", "LeastSquares"),
    "recursive-least-squares": _Entry("least_squares", "RecursiveLeastSquares"),
    "clipped-least-squares": _Entry("adaptive", "ClippedLeastSquares"),
    "bayesian-least-squares": _Entry("adaptive", "BayesianLeastSquares"),
    PARTS: _Entry("parts", "Parts"),
    "theil-sen": _Entry("robust", "TheilSen"),
    "huber": _Entry("robust", "Huber"),
    "random-forest": _Entry("random_forest", "RandomForest", slow=True),
    "arima": _Entry("arima", "Arima", slow=True),
    "sarima": _Entry("arima", "Sarima", slow=True),
    "lstm": _Entry("lstm", "Lstm", slow=True),
    "river": _Entry("river_model", "River", follows=_CLASS),
}


def names() -> tuple[str, ...]:
    """All names that stand for a predictor by themselves."""
    return tuple(name for name, entry in _ENTRIES.items() if not entry.follows)


HELP = f"{', '.join(names())}, or river:{_CLASS}"


def make(name: str, window: int, seed: int = 0) -> Predictor:
    """A new predictor that remembers the last `window` executions. The same seed gives the same answers.

    MissingExtra if its library is not installed.
    """
    check_name(name)
    entry, rest = _find(name)
    module = importlib.import_module(f"offboard.robot_client.predictors.{entry.module}")
    factory = getattr(module, entry.factory)
    made: Predictor = factory(rest, window, seed) if entry.follows else factory(window, seed=seed)
    return made


def slow(name: str) -> bool:
    """Whether one fit of this predictor takes tenths of a second or more."""
    return _find(name)[0].slow


def check_name(name: str, where: str = "predictor") -> None:
    """Raise ConfigError unless `make` knows the name; `where` names its flag or field. Loads nothing."""
    try:
        _find(name)
    except KeyError:
        raise ConfigError(f"{where}: {name!r} is not one of {HELP}") from None


def _find(name: str) -> tuple[_Entry, str]:
    """The entry of a name, and what follows its colon; KeyError if there is no such predictor."""
    head, colon, rest = name.partition(":")
    entry = _ENTRIES[head]
    if bool(colon) != bool(entry.follows):
        raise KeyError(name)
    return entry, rest
