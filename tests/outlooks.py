"""Outlooks and decisions for tests of single rules and wrappers."""

from collections.abc import Mapping
from typing import Any

from offboard.robot_client import policies
from offboard.robot_client.policies import Decision, Forecast, Outlook, Policy

UNKNOWN = Outlook()


def known(seconds: float, **fields: Any) -> Outlook:
    """A site that is well known; its spread is a tenth of its time."""
    return Outlook(
        **{"predicted_s": seconds, "spread_s": 0.1 * seconds, "full": True, "observations": 50} | fields
    )


def decide(policy: str | Policy, sites: Mapping[str, Outlook], **fields: Any) -> Decision:
    """What the policy decides for a task of size 1."""
    made = policies.make(policy) if isinstance(policy, str) else policy
    return made.decide(Forecast(size=1.0, sites=sites, **fields))
