"""The policy contract holds for every rule in every wrapping, and names stand for what they say."""

from collections.abc import Callable
from itertools import permutations

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies.hedge import WithHedges
from tests import policy_checks

WRAPPERS = ("probe", "hedge", "budget")
WRAPPINGS = [":".join(some) for count in range(4) for some in permutations(WRAPPERS, count)]


@pytest.mark.parametrize("rule", policies.names())
@pytest.mark.parametrize("check", policy_checks.CONTRACT, ids=lambda check: check.__name__)
def test_contract(check: Callable[[policy_checks.Make], None], rule: str) -> None:
    """Every check of the contract holds for every rule in every order of wrappers."""
    for wrapping in WRAPPINGS:
        name = f"{wrapping}:{rule}".removeprefix(":")
        try:
            check(lambda name=name: policies.make(name, seed=3))
        except Exception as error:
            raise AssertionError(f"policy {name}") from error


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("gredy", "'gredy' is not one of paper, paper-with-heartbeats, onboard, cloud, greedy, default"),
        ("", "'' is not one of paper"),
        ("hedge", "'hedge' is not one of paper"),
        ("hegde:greedy", "'hegde' is not one of probe, hedge, budget, once each"),
        ("hedge:hedge:greedy", "'hedge' is not one of probe, hedge, budget, once each"),
        (":greedy", "'' is not one of probe, hedge, budget, once each"),
        ("hedge:default", "'hedge' is not one of probe, hedge, budget, once each"),
    ],
)
def test_the_error_for_a_wrong_name_is_one_line(name: str, says: str) -> None:
    """The error names what is wrong and every name that is allowed."""
    with pytest.raises(ConfigError) as refused:
        policies.make(name)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_default_is_a_name_like_any_other() -> None:
    """`default` stands for hedge:probe:greedy, also with wrappers in front."""
    policies.check_name("default")
    policies.check_name("budget:default")
    assert policies.full_name("default") == policies.DEFAULT
    assert policies.full_name("budget:default") == f"budget:{policies.DEFAULT}"
    assert policies.full_name("paper") == "paper"
    assert isinstance(policies.make("default"), WithHedges)
    assert policies.predictor_of("default") == policies.predictor_of("greedy")
    assert policies.weighs_cost("default")


def test_the_constants_predict_as_the_default_does() -> None:
    """Only that predictor knows what a byte takes, so without it they would compress nothing."""
    of_default = policies.predictor_of("default")
    assert [policies.predictor_of(name) for name in ("onboard", "cloud")] == [of_default] * 2
    assert policies.predictor_of("paper") == predictors.LEAST_SQUARES


@pytest.mark.parametrize("name", policies.names())
def test_every_rule_names_a_predictor_that_exists(name: str) -> None:
    """The predictor that a policy is meant for can be made, and wrappers do not change it."""
    assert predictors.make(policies.predictor_of(f"hedge:probe:{name}"), 5).predict(1.0) is None
    assert policies.predictor_of(f"hedge:{name}") == policies.predictor_of(name)
