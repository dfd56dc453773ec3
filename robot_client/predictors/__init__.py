"""Predictors by name; one family a file."""

from collections.abc import Callable

from common.errors import ConfigError
from robot_client.predictors.base import Prediction, Predictor
from robot_client.predictors.linear import LeastSquares

__all__ = ["LEAST_SQUARES", "Prediction", "Predictor", "make", "names"]

LEAST_SQUARES = "least-squares"

_MAKERS: dict[str, Callable[[int], Predictor]] = {LEAST_SQUARES: LeastSquares}


def make(name: str, window: int) -> Predictor:
    """A fresh predictor that remembers the last `window` executions."""
    if name not in _MAKERS:
        raise ConfigError(f"predictor {name!r} is not one of {', '.join(names())}")
    return _MAKERS[name](window)


def names() -> tuple[str, ...]:
    return tuple(_MAKERS)
