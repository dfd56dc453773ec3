"""Asks and teaches a model as the memory of a site does."""

from typing import Any

from offboard.robot_client.predictors import Model, Prediction, Predictor
from offboard.robot_client.predictors.base import Call, Run
from offboard.robot_client.sites.runner import UNMEASURED, Condition


def predict(
    model: Model, size: float, *, moved: float = 0.0, condition: Condition = UNMEASURED
) -> Prediction | None:
    return model.predict(Call(size, moved, condition))


def learn(
    model: Model,
    size: float,
    seconds: float,
    *,
    moved: float = 0.0,
    condition: Condition = UNMEASURED,
    **run: Any,
) -> None:
    """The further arguments are the fields of `Run`."""
    model.learn(Call(size, moved, condition), Run(seconds, **run))


class Sized:
    """A predictor that asks a model for sizes only: what holds for every predictor holds for it too."""

    def __init__(self, model: Model) -> None:
        self._model = model

    @property
    def full(self) -> bool:
        return self._model.full

    def __len__(self) -> int:
        return len(self._model)

    def learn(self, size: float, seconds: float) -> None:
        learn(self._model, size, seconds)

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:
        return self._model.predict(Call(size, ahead=ahead))


def sized(made: Predictor | Model) -> Predictor:
    """The same predictor, or a model as one."""
    return Sized(made) if hasattr(made, "at_site") else made  # type: ignore[arg-type, return-value]
