"""Calls that are pinned: the caller says on which site they run, or on `both` to measure all of them.

All other calls are decided by the policy.
"""

from collections.abc import Collection

from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind
from offboard.robot_client.policies import BOTH, PINNED, Decision, Forecast
from offboard.robot_client.sites.runner import ONBOARD


def check_where(where: str, kind: Kind, sites: Collection[str]) -> None:
    """ConfigError unless a task of this kind may be pinned there."""
    if where != BOTH and where not in sites:
        raise ConfigError(f"where={where!r} is not one of {', '.join([*sites, BOTH])}")
    if where == BOTH and not kind.duplicate:
        raise ConfigError(f"where='both': task {kind.name} is declared duplicate=False")


def pinned(where: str, forecast: Forecast) -> Decision:
    """The decision for a pinned call; it runs onboard if its site cannot take it."""
    if where == BOTH:
        both = len(forecast.sites) > 1
        why = "measured on both" if both else "only onboard was there"
        return Decision(ONBOARD, why, PINNED, both=both)
    if where not in forecast.sites:
        return Decision(ONBOARD, f"pinned to {where}, which cannot take it", PINNED)
    return Decision(where, "pinned by the caller", PINNED)
