"""The parts model without one of its mechanisms: each class leaves out something, and nothing by accident."""

import copy
import inspect
from collections.abc import Iterator
from random import Random

import pytest

from benchmarks import left_out
from benchmarks.ablations import LEFT_OUT
from benchmarks.left_out import Switched
from offboard.common.config import find_class
from offboard.loadgen.compare.compare_settings import split_strategy
from offboard.robot_client.policies import Hedge
from offboard.robot_client.policies.prediction_errors import PredictionErrors
from offboard.robot_client.predictors.line import Line
from offboard.robot_client.predictors.parts import Parts
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import Condition
from tests.models import learn, predict
from tests.outlooks import decide, known

CLASSES = [
    one
    for name, one in inspect.getmembers(left_out, inspect.isclass)
    if issubclass(one, Parts) and one is not Parts and not name.startswith("_")
]


def predictions(model: Parts) -> Iterator[float]:
    """What a model predicts of a server that changes all that a model can learn, task by task."""
    rng, rtt_s, load, slow = Random(1), 0.03, 0.0, 1.0
    model.remote = True
    for n in range(400):
        if n % 40 == 0:
            rtt_s, load, slow = rng.choice([0.03, 0.12]), rng.choice([0.0, 0.7]), rng.choice([1.0, 20.0])
        size, moved, odd = rng.uniform(0.5, 2.0), rng.uniform(1e3, 1e5), 8.0 if n % 25 == 9 else 1.0
        condition = Condition(
            round_trip_s=rtt_s, queue=rng.randrange(2), capacity=rng.choice([0.5, 1.0]), server_load=load
        )
        found = predict(model, size, moved=moved, condition=condition)
        yield found.seconds if found else 0.0
        run_s = 0.1 * size * odd * slow * (1.0 + load) * rng.lognormvariate(0.0, 0.1) / condition.capacity
        seconds = rtt_s + 0.03 + moved / 4e6 * odd * slow + run_s
        if n % 30 == 29:
            learn(model, size, 2.0 * seconds, ended=False, moved=moved, condition=condition)
            continue
        learn(
            model,
            size,
            seconds,
            run_s=run_s,
            queue_s=0.01,
            moved=moved,
            bound=rng.random() < 0.2,
            condition=condition,
        )


@pytest.mark.parametrize("together", [True, False])
def test_a_line_with_all_its_switches_on_is_the_line(together: bool) -> None:
    """The copy of its rules predicts the same, to the last digit."""
    rng, line, switched = Random(1), Line(together=together), Switched(together=together)
    for n in range(500):
        x, factor = rng.uniform(0.5, 2.0), rng.choice([1.0] * 9 + [0.2, 6.0]) * (3.0 if n > 250 else 1.0)
        y = (0.1 + 0.3 * x) * factor * rng.lognormvariate(0.0, 0.2)
        for one in (line, switched):
            one.learn(x, y, 0.03)
        assert (line.at(1.0), line.tail, line.deviation) == (
            switched.at(1.0),
            switched.tail,
            switched.deviation,
        )


@pytest.mark.parametrize("left", CLASSES)
def test_each_class_leaves_something_out(left: type[Parts]) -> None:
    """It predicts other times than the whole model, or learns seconds per size."""
    assert list(predictions(left())) != list(predictions(Parts())) or not left.per_work
    assert copy.deepcopy(left()).full is False


def test_the_whole_model_is_compared_with_itself() -> None:
    """A subclass that leaves nothing out predicts the same."""

    class Same(Parts):
        LINE = Switched

    assert list(predictions(Same())) == list(predictions(Parts()))


def test_each_strategy_is_one_that_loadgen_knows() -> None:
    """Every class is in the table, under a name that `--policies` accepts."""
    found = set()
    for one in LEFT_OUT.values():
        assert split_strategy(one.strategy) == (one.policy, one.predictor)
        if one.predictor:
            found.add(find_class(one.predictor, "predictor"))
    assert found == set(CLASSES)


@pytest.mark.parametrize(("name", "per_work"), [("Tail", True), ("Work", False)])
def test_a_subclass_of_the_model_learns_per_work_as_the_model_does(name: str, per_work: bool) -> None:
    """Its attribute `per_work` decides, so that only the mechanism in question differs."""
    memories = Settings(predictor=f"benchmarks.left_out.{name}", window=20).make_memories("greedy")
    assert memories._shared_work is per_work


def test_without_the_stall_a_late_heartbeat_adds_nothing() -> None:
    """The default leaves a server whose heartbeat is late; without the rule it goes there.

    The outlooks have their costs, as those of a robot do.
    """
    cloud = known(0.3, condition=Condition(wait_s=0.2))._replace(cost=0.3)
    sites = {"onboard": known(0.2)._replace(cost=0.2), "cloud": cloud}
    assert decide("default", sites).site == "onboard"
    assert decide(left_out.Stall(), sites).site == "cloud"


def test_a_hedge_at_p95_starts_at_that_quantile() -> None:
    """The default waits for the age with the longest rest; the other one for the 95th percentile."""
    errors = PredictionErrors(scores=(0.0,) * 15 + (1.0,) * 3 + (2.0, 9.0), usual_s=1.0)
    sites = {"onboard": known(3.0), "cloud": known(1.0, errors=errors)}
    whole, other = (decide(policy, sites).second for policy in ("default", left_out.HedgeAtP95()))
    assert whole == Hedge("onboard", 3.0)
    assert other == Hedge("onboard", 10.0)
