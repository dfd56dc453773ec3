"""What a policy decides, and the contract of every policy.

What a decision is based on is in `forecast`; `execution/race.py` carries it out.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from offboard.robot_client.policies.forecast import Forecast

PINNED = "pinned"  # stands for the policy where the caller said where to run
ALONE = "none"  # stands for the policy where only onboard was there
BOTH = "both"  # `where=BOTH`: the caller measures the task on all sites


@dataclass(frozen=True, slots=True)
class Probe:
    """Run the task on `site` too, from the start, to learn how long it takes there.

    The first good answer is used. The slower run goes on to its end, so that its time is learnt.
    Without `answers` it starts after the task was answered: it delays nothing, and its answer is not used.
    """

    site: str
    answers: bool = True


@dataclass(frozen=True, slots=True)
class Hedge:
    """Run the task on `site` too if no answer has come after `after_s` seconds.

    The first good answer is used, and the other run is cancelled.
    """

    site: str
    after_s: float


class Decision(NamedTuple):
    """Run the task on `site`; with `both`, on all sites except those in `spared`, in parallel.

    The first good answer is used, and the other runs go on; with `waits`, the caller gets its answer when all
    runs have ended.
    `latest`: a run that starts at the latest then, if no answer has come, outside of the allowance unless it
    starts at once: a call with a deadline must not wait for a remote site alone.
    `why` is the reason for people, or a function that makes it: few reasons are ever read.
    `policy` names who decided: the rule, or the whole policy once it is `Named`. `second` is a second run on
    another site. `advised` is where the policy would send a task that `Observe` runs onboard.
    """

    site: str
    why: str | Callable[[], str]
    policy: str
    both: bool = False
    second: Probe | Hedge | None = None
    spared: tuple[str, ...] = ()
    advised: str | None = None
    waits: bool = False
    latest: Hedge | None = None

    @property
    def measured(self) -> str | None:
        """The site of a probe without `answers`."""
        second = self.second
        return None if not isinstance(second, Probe) or second.answers else second.site

    @property
    def reason(self) -> str:
        return self.why if isinstance(self.why, str) else self.why()


class Policy(Protocol):
    """Decides where a task runs. Called once for each task, under the offloader's lock.

    A policy uses no clock, no socket and no global randomness: rules that draw get a seeded generator.
    """

    def decide(self, forecast: Forecast) -> Decision: ...


class Named:
    """Gives the decisions of a policy the name that the user wrote, such as `hedge:probe:greedy`."""

    def __init__(self, policy: Policy, name: str) -> None:
        self._policy = policy
        self._name = name
        self.pairs = pairs(policy)

    def decide(self, forecast: Forecast) -> Decision:
        found = self._policy.decide(forecast)
        # All fields in their order: `_replace` is slower.
        return Decision._make((
            found.site, found.why, self._name, found.both, found.second, found.spared, found.advised,
            found.waits, found.latest,
        ))  # fmt: skip


def pairs(policy: Policy) -> bool:
    """Whether this policy starts onboard in time for a deadline while a remote site runs the task."""
    return bool(getattr(policy, "pairs", False))


def decide_among(sites: Collection[str], forecast: Forecast, policy: Policy) -> Decision:
    """What the policy decides if only these sites are offered; a decision for all sites spares the others."""
    decision = policy.decide(forecast.only(sites))
    if not decision.both:
        return decision
    left_out = [site for site in forecast.sites if site not in sites]
    return decision._replace(spared=(*decision.spared, *left_out))
