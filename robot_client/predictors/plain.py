"""The model of a plain predictor, which learns pairs of size and seconds and knows nothing else of a task."""

from offboard.common.tasks import Size, first_number
from offboard.robot_client.predictors.base import Call, Model, Prediction, Predictor, Run


class Plain:
    """Times are those that the published rule learns: with the packing, and of failed runs too."""

    learns_failures = True
    byte_s = None

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        self._several = getattr(predictor, "several_numbers", False)

    @property
    def full(self) -> bool:
        return self._predictor.full

    def __len__(self) -> int:
        return len(self._predictor)

    def predict(self, call: Call) -> Prediction | None:
        return self._predictor.predict(self._size(call.amount), call.ahead)

    def learn(self, call: Call, run: Run) -> None:
        self._predictor.learn(self._size(call.amount), run.seconds + run.pack_s)

    def _size(self, amount: Size) -> float:
        return amount if self._several else first_number(amount)  # type: ignore[return-value] # see `LeastSquares`


def model_of(predictor: Predictor | Model, *, remote: bool) -> Model:
    """The model that a predictor makes of a site, or else the plain one. `remote`: behind a network."""
    at_site = getattr(predictor, "at_site", None)
    model: Model = Plain(predictor) if at_site is None else at_site(remote=remote)  # type: ignore[arg-type]
    return model
