"""The rules of peers that use several servers: which sites run a task, and when a second one starts."""

import copy
from pathlib import Path

import numpy as np
import pytest

from benchmarks.claims_of_others import paired
from offboard.loadgen.compare.recordings import RecordedLink
from offboard.loadgen.rivals.peer_policies import HedgeAtP90, QuantileSketch, Replicate, TwoServers
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

MODULE = "offboard.loadgen.rivals.peer_policies"


def forecast(duplicates: float = 1.0, **predicted_s: float | None) -> Forecast:
    sites = {site: Outlook(predicted_s=seconds) for site, seconds in predicted_s.items()}
    return Forecast(size=1.0, sites=sites, duplicates=duplicates)


def started(decision: Decision, among: Forecast) -> set[str]:
    """The sites that run the task from its start."""
    return set(among.sites) - set(decision.spared) if decision.both else {decision.site}


def test_replication_uses_every_server_and_never_the_robot() -> None:
    """However slow they are; without a server the robot is left."""
    known = forecast(onboard=0.001, cloud=1.0, east=None, west=0.5)
    decision = Replicate().decide(known)
    assert started(decision, known) == {CLOUD, "east", "west"}
    assert not decision.waits, "the first answer is used"
    assert Replicate().decide(forecast(onboard=0.1)).site == ONBOARD


def test_a_fixed_redundancy_of_two_takes_the_fastest_and_unknown_ones() -> None:
    """A server of which nothing is known yet comes first, so that it becomes known."""
    known = forecast(onboard=0.001, cloud=1.0, east=0.4, west=0.5)
    assert started(TwoServers().decide(known), known) == {"east", "west"}
    known = forecast(onboard=0.001, cloud=None, east=0.4, west=0.5)
    assert started(TwoServers().decide(known), known) == {CLOUD, "east"}
    known = forecast(onboard=0.001, cloud=0.4)
    assert started(TwoServers().decide(known), known) == {CLOUD}


def test_a_hedge_starts_on_the_second_server_after_the_percentile_of_the_first() -> None:
    """As long as a second run is left; one server alone has no second."""
    first = HedgeAtP90().decide(forecast(onboard=0.001, cloud=0.2, east=0.1))
    assert (first.site, first.second) == (CLOUD, Hedge("east", 0.2))
    assert HedgeAtP90().decide(forecast(0.5, cloud=0.2, east=0.1)).second is None
    assert HedgeAtP90().decide(forecast(cloud=0.2)).second is None
    assert HedgeAtP90().decide(forecast(cloud=None, east=0.1)).second is None


def test_the_sketch_knows_the_percentile_to_its_accuracy() -> None:
    """Of the last times: after a change, the old ones are forgotten."""
    random, sketch = np.random.default_rng(5), QuantileSketch(200)
    assert sketch.predict(1.0) is None
    for scale in (1.0, 20.0):
        seconds = scale * random.lognormal(-3, 0.5, 400)
        for one in seconds.tolist():
            sketch.learn(1.0, one)
        found = sketch.predict(1.0)
        assert found is not None
        assert found.seconds == pytest.approx(np.quantile(seconds[-400:], 0.9), rel=0.05)
    assert sketch.full
    copied = copy.deepcopy(sketch).predict(1.0)
    assert copied is not None
    assert copied.seconds == found.seconds


def test_robots_know_the_rules_by_their_paths() -> None:
    """And the hedge brings its predictor."""
    for name in ("Replicate", "TwoServers", "HedgeAtP90"):
        policies.make(f"{MODULE}.{name}")
    path = policies.predictor_of(f"{MODULE}.HedgeAtP90")
    assert isinstance(predictors.make(path, 20, 0), QuantileSketch)


def test_recordings_of_two_networks_are_paired_by_road() -> None:
    """Each is used once, and one without a partner is left out."""
    names = ("town-n8-1", "town-n78-1", "town-n78-2", "road-n8-1", "road-n8-2", "road-n78-1", "hill-n8-1")
    links = [RecordedLink("car", name, {"recording": Path(f"{name}.csv")}) for name in names]
    found = [(one.name, other.name) for one, other in paired(links)]
    assert found == [("town-n78-1", "town-n8-1"), ("road-n78-1", "road-n8-1")]
