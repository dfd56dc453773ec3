"""What the tasks of an offloader teach its memories, and when."""

from random import Random

import pytest

from offboard.common.tasks import kind_of, task
from offboard.robot_client import policies
from offboard.robot_client.learning.site import SiteMemory
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Probe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Sending
from tests.virtual import VirtualClock, VirtualRunner

ONBOARD_S, CLOUD_S = 0.1, 0.05  # of a task of size 1
RUN_S = 0.03  # of this task in the cloud
PLAIN = {site: Decision(site, "plain", "scripted") for site in (ONBOARD, CLOUD)}
PROBE = Decision(ONBOARD, "probe", "scripted", second=Probe(CLOUD))


@task("learning_echo", size=lambda number: number)
def learning_echo(number: float) -> float:
    return number


class Scripted:
    """Decides what the test has set as `next`."""

    def __init__(self) -> None:
        self.next = PLAIN[ONBOARD]

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self.next


class Scene:
    """A robot that knows both sites, in virtual time; `policy` is where the predictor comes from."""

    def __init__(self, policy: str = policies.DEFAULT, allowance: Allowance | None = None) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (ONBOARD, CLOUD)}
        self.sites[CLOUD].fields = {"queue_s": 0.0, "run_s": RUN_S, "bytes_out": 1000}
        self.policy = Scripted()
        self.memories = Settings().make_memories(policy)
        self.offload = Offloader(
            list(self.sites.values()),
            policy=self.policy,
            memories=self.memories,
            allowance=allowance or Allowance(1.0),
            clock=self.clock,
        )
        random = Random(1)
        for _ in range(20):
            noise = random.uniform(0.98, 1.02)
            self.ask(PLAIN[ONBOARD], onboard_s=ONBOARD_S * noise)
            self.ask(PLAIN[CLOUD], cloud_s=CLOUD_S * noise)

    def ask(
        self,
        decision: Decision,
        *,
        onboard_s: float | None = ONBOARD_S,
        cloud_s: float | None = CLOUD_S,
    ) -> None:
        """Run a task of size 1; the sites take these seconds, or never answer (None)."""
        self.policy.next = decision
        for site, seconds in ((ONBOARD, onboard_s), (CLOUD, cloud_s)):
            self.sites[site].scripts.append((seconds, None))
        self.offload(learning_echo, 1.0)
        for runner in self.sites.values():
            runner.scripts.clear()

    def site(self, name: str = CLOUD) -> SiteMemory:
        return self.memories.of(kind_of(learning_echo), self.sites).site(name)

    def predicted_s(self) -> float:
        """What the cloud is expected to take, while nothing is measured of it."""
        found = self.site().outlook(1.0, UNMEASURED, in_flight=0, sending=Sending(1000))
        assert found.predicted_s is not None
        return found.predicted_s


@pytest.mark.parametrize("policy", ["paper", policies.DEFAULT])
def test_each_task_is_learned_before_the_next_is_decided(policy: str) -> None:
    """As in Algorithm 1, the next decision knows every time before it."""
    scene = Scene(policy)
    for n in range(1, 6):
        scene.ask(PLAIN[CLOUD])
        assert len(scene.site(CLOUD).observations) == 20 + n
    assert scene.site(ONBOARD).age == 6


def test_a_run_that_goes_on_is_learned_when_it_ends() -> None:
    """A probe that is slower than the answer is learned with its whole time."""
    scene = Scene()
    before = len(scene.site().observations)
    scene.ask(PROBE, cloud_s=0.4)
    assert len(scene.site().observations) == before
    scene.clock.run_out()
    assert scene.site().observations[-1].seconds == pytest.approx(0.4)


def test_an_execution_is_learned_with_the_condition_of_its_decision() -> None:
    """What is measured of the site while the task runs does not count."""
    scene = Scene()
    busy = Condition(round_trip_s=0.01, server_load=0.8)
    scene.sites[CLOUD].measured = busy
    scene.clock.after(0.01, lambda: setattr(scene.sites[CLOUD], "measured", UNMEASURED))
    scene.ask(PLAIN[CLOUD])
    assert scene.site().observations[-1].condition == busy


@pytest.mark.parametrize(
    ("condition", "learned"),
    [(UNMEASURED, True), (Condition(silent=True), False), (Condition(wait_s=0.2), False)],
    ids=["alive", "silent", "held up"],
)
def test_a_timeout_of_a_site_that_is_away_teaches_nothing(condition: Condition, learned: bool) -> None:
    """Heartbeats tell when the site is back, and then its old time counts.

    If it was there all the time, it soon looks slower than onboard.
    """
    scene = Scene()
    before_s = scene.predicted_s()
    for _ in range(6):
        scene.sites[CLOUD].measured = UNMEASURED
        scene.clock.after(0.1, lambda: setattr(scene.sites[CLOUD], "measured", condition))
        scene.ask(PLAIN[CLOUD], cloud_s=None)
    if learned:
        assert scene.predicted_s() > 2 * ONBOARD_S
    else:
        assert scene.predicted_s() == pytest.approx(before_s)


@pytest.mark.parametrize(("decision", "slower"), [(PROBE, False), (PLAIN[CLOUD], True)])
def test_a_probe_during_an_onboard_run_does_not_make_a_server_look_slow(
    decision: Decision, slower: bool
) -> None:
    """The busy robot may receive the answer late; without an onboard run, the late time counts."""
    scene = Scene()
    for _ in range(30):
        scene.ask(decision, cloud_s=1.5 * CLOUD_S)
        scene.clock.run_out()
    assert (scene.predicted_s() > 1.2 * CLOUD_S) == slower


def test_probes_measure_the_regret() -> None:
    """After WARM_UP probes that were faster, the regret is the time that they would have saved."""
    scene = Scene()
    regret = None
    for _ in range(WARM_UP + 1):
        scene.ask(PROBE, onboard_s=0.1, cloud_s=0.04)
        scene.clock.run_out()
        assert scene.offload.last is not None
        regret = scene.offload.last.regret
    assert regret is not None
    assert regret.mean_s == pytest.approx(0.06)


def test_bytes_are_taken_from_the_caps_when_a_task_ends() -> None:
    """Only what a server received and sent counts."""
    allowance = Allowance(bytes_a_minute=1e6)
    scene = Scene(allowance=allowance)
    scene.sites[CLOUD].fields["bytes_out"] = 500_000
    before = allowance.bytes_left
    scene.ask(PLAIN[CLOUD])
    spent = before - allowance.bytes_left
    assert spent == pytest.approx(500_000, rel=0.05), "the cap is refilled with the time"
    scene.ask(PLAIN[ONBOARD])
    assert before - allowance.bytes_left <= spent


def test_nothing_is_learned_after_close() -> None:
    """A run that `close` ended says nothing about its site."""
    scene = Scene()
    scene.ask(PROBE, cloud_s=0.4)
    before = len(scene.site().observations)
    scene.offload.close()
    scene.clock.run_out()
    assert len(scene.site().observations) == before
