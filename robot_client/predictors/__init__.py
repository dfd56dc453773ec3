"""The registry of predictors: the two that robots need, by name, and any other by the path of its class."""

from offboard.common.config import MODULE_CLASS, find_class
from offboard.common.errors import ConfigError
from offboard.robot_client.predictors.base import Model, Prediction, Predictor

__all__ = ["LEAST_SQUARES", "PARTS", "Model", "Prediction", "Predictor", "check_name", "make", "names"]

LEAST_SQUARES = "least-squares"
PARTS = "parts"
_HOME = "offboard.robot_client.predictors"
_CLASSES = {LEAST_SQUARES: f"{_HOME}.least_squares.LeastSquares", PARTS: f"{_HOME}.parts.Parts"}
HELP = f"{', '.join(_CLASSES)}, or {MODULE_CLASS} of your own"


def names() -> tuple[str, ...]:
    """The short names."""
    return tuple(_CLASSES)


def make(name: str, window: int, seed: int = 0) -> Predictor | Model:
    """A new predictor that remembers the last `window` executions. The same seed gives the same answers."""
    check_name(name)
    made: Predictor | Model = find_class(_CLASSES.get(name, name), "predictor")(window, seed=seed)
    return made


def check_name(name: str, where: str = "predictor", allowed: str = HELP) -> None:
    """ConfigError unless the name is known or a path; `where` names its flag or field. Loads nothing."""
    if name not in _CLASSES and ("." not in name or ":" in name):
        raise ConfigError(f"{where}: {name!r} is not one of {allowed}")
