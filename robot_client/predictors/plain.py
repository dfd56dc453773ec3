"""The model of a plain predictor, which learns pairs of size and seconds and knows nothing else of a task."""

from typing import Any

from offboard.common.tasks import first_number
from offboard.robot_client.predictors.base import Call, Model, Prediction, Predictor, Run


class Plain:
    """Times are those that the published rule learns: with the packing, and of failed runs too."""

    learns_failures = True
    byte_s = None

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        self._several = getattr(predictor, "several_numbers", False)
        self.full = predictor.full

    def __len__(self) -> int:
        return len(self._predictor)

    def predict(self, call: Call) -> Prediction | None:
        size: Any = call.amount if self._several else first_number(call.amount)
        return self._predictor.predict(size, call.ahead)

    def learn(self, call: Call, run: Run) -> None:
        size: Any = call.amount if self._several else first_number(call.amount)
        self._predictor.learn(size, run.seconds + run.pack_s)
        self.full = self._predictor.full


def model_of(predictor: Predictor | Model, *, remote: bool) -> Model:
    """The model that a predictor makes of a site, or else the plain one. `remote`: behind a network."""
    at_site = getattr(predictor, "at_site", None)
    model: Model = Plain(predictor) if at_site is None else at_site(remote=remote)  # type: ignore[arg-type]
    return model
