"""Why a site was chosen, in words: predictions, what was measured, and how old the other sites are."""

from offboard.common.tasks import Size
from offboard.common.wording import duration, with_interval
from offboard.robot_client.policies.forecast import WHOLE, Forecast, Outlook
from offboard.robot_client.sites.runner import ONBOARD, Condition


def explain(forecast: Forecast, site: str) -> str:
    """The reason to choose this site: predictions, what was measured, how old the other sites are."""
    sites = forecast.sites
    parts, stale = [f"{site}: {_times(sites[site])}"], ""
    measured = f"size {show_size(forecast.size, '.3g')}"
    for name, one in sites.items():
        if name != site:
            parts.append(f"{name} {_times(one)}")
            if one.age:
                stale += f"; {name} last tried {one.age} tasks ago"
        measured += _measured(name, one.condition, "" if len(sites) == 2 else f" {name}")
    return f"{' against '.join(parts)}; {measured}{stale}"


def _times(one: Outlook) -> str:
    """The prediction, and the quality of the site's variant with its worth in time."""
    said, quality = _predicted(one), one.quality
    if quality is WHOLE:
        return said
    if quality.lost_s:
        return f"{said} + {duration(quality.lost_s)} for quality {quality.value:g}"
    return f"{said}, quality {quality.value:g}"


def _predicted(one: Outlook) -> str:
    if one.condition.silent:
        return "silent"
    if one.predicted_s is None:
        return "unknown"
    if one.low_s is None or one.high_s is None:
        return duration(one.predicted_s)
    return with_interval(one.predicted_s, one.low_s, one.high_s)


def _measured(site: str, condition: Condition, of: str) -> str:
    said, there = "", of if of or site == ONBOARD else " there"
    if condition.round_trip_s is not None:
        said = f", queue{of} {condition.queue}, rtt{of} {duration(condition.round_trip_s)}"
    if site == ONBOARD and condition.load >= 0.005:
        said += f", load{of} {condition.load:.0%}"
    if condition.server_load >= 0.005:
        said += f", load{there} {condition.server_load:.0%}"
    if condition.capacity < 1.0:
        said += f", capacity{there} {condition.capacity:.0%}"
    if condition.wait_s:
        said += f", wait{of} {duration(condition.wait_s)}"
    return said


def show_size(size: Size, form: str) -> str:
    """A size in words, with each number in this format."""
    numbers = size if isinstance(size, tuple) else (size,)
    return " and ".join(format(number, form) for number in numbers)
