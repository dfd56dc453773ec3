"""The registry of predictors: their names, and what each name stands for.

A family of predictors has a file of its own, which is loaded when one of its names is asked for.
"""

import importlib
from dataclasses import dataclass

from offboard.common.errors import ConfigError
from offboard.robot_client.predictors.base import Prediction, Predictor

__all__ = ["LEAST_SQUARES", "Prediction", "Predictor", "check_name", "conditional", "make", "names", "slow"]

LEAST_SQUARES = "least-squares"
AVERAGE = "average"
WORK = "work:"  # before any name: times are learnt per work if the kind says how much work a task was
_NAME, _CLASS = "NAME", "MODULE.CLASS"


@dataclass(frozen=True, slots=True)
class _Entry:
    """What one name stands for.

    module, factory: where the predictor is made.
    follows: what stands after the name and a colon, if anything: another predictor, or a class of river.
    conditional: it is asked and taught with the measured condition of a site.
    slow: one fit takes tenths of a second or more.
    """

    module: str
    factory: str
    follows: str = ""
    conditional: bool = False
    slow: bool = False


_ENTRIES: dict[str, _Entry] = {
    LEAST_SQUARES: _Entry("least_squares", "LeastSquares"),
    "recursive-least-squares": _Entry("least_squares", "RecursiveLeastSquares"),
    "clipped-least-squares": _Entry("adaptive", "ClippedLeastSquares"),
    "bayesian-least-squares": _Entry("adaptive", "BayesianLeastSquares"),
    "kalman": _Entry("adaptive", "Kalman"),
    "blind-average": _Entry("average", "blind_average", conditional=True),
    AVERAGE: _Entry("average", "Average", conditional=True),
    "parts": _Entry("parts", "make_parts", conditional=True),
    "theil-sen": _Entry("robust", "TheilSen"),
    "huber": _Entry("robust", "Huber"),
    "random-forest": _Entry("random_forest", "RandomForest", slow=True),
    "arima": _Entry("arima", "Arima", slow=True),
    "sarima": _Entry("arima", "Sarima", slow=True),
    "lstm": _Entry("lstm", "Lstm", slow=True),
    "river": _Entry("river_model", "River", follows=_CLASS),
    "features": _Entry("features", "Measured", follows=_NAME, conditional=True),
}


def names() -> tuple[str, ...]:
    """All names that stand for a predictor by themselves."""
    return tuple(name for name, entry in _ENTRIES.items() if not entry.follows)


HELP = f"{', '.join(names())}, or river:{_CLASS}; features:{_NAME} also uses what is measured of a site"


def make(name: str, window: int, seed: int = 0) -> Predictor:
    """A new predictor that remembers the last `window` executions. The same seed gives the same answers.

    MissingExtra if its library is not installed.
    """
    check_name(name)
    entry, rest = _find(name)
    module = importlib.import_module(f"offboard.robot_client.predictors.{entry.module}")
    factory = getattr(module, entry.factory)
    made: Predictor
    if entry.follows == _NAME:
        made = factory(make(rest, window, seed))
    elif entry.follows == _CLASS:
        made = factory(rest, window, seed)
    else:
        made = factory(window, seed=seed)
    return made


def conditional(name: str) -> bool:
    """Whether this predictor uses the measured condition of a site."""
    return _find(name)[0].conditional


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
    head, colon, rest = name.removeprefix(WORK).partition(":")
    entry = _ENTRIES[head]
    if bool(colon) != bool(entry.follows):
        raise KeyError(name)
    if entry.follows == _NAME and (rest.startswith(WORK) or _find(rest)[0].follows == _NAME):
        raise KeyError(name)
    return entry, rest
