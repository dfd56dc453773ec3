"""Phases in which onboard, edge or cloud fails, and how soon the best remaining site is used."""

from collections.abc import Sequence

from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

EDGE = "edge"
TASKS = 100  # per phase
WITHIN = 30  # tasks after a change
SPAN, MOST = 10, 8  # the best site must answer 8 of 10 tasks: other sites are tried now and then
# The sites that fail in each phase, and the best site then.
PHASES: tuple[tuple[tuple[str, ...], str], ...] = (
    ((), EDGE),
    ((EDGE,), CLOUD),
    ((CLOUD,), EDGE),
    ((ONBOARD,), EDGE),
    ((EDGE, CLOUD), ONBOARD),
    ((), EDGE),
)


def switch_point(used: Sequence[str | None], best: str) -> int | None:
    """The first task after which the best site answers MOST of any SPAN tasks; None if there is none."""
    right = [site == best for site in used]
    bad = [n for n in range(len(right) - SPAN + 1) if sum(right[n : n + SPAN]) < MOST]
    first = bad[-1] + 1 if bad else 0
    return next((n for n in range(first, len(right) - SPAN + 1) if right[n]), None)


def check(records: Sequence[Record], within: int = WITHIN) -> None:
    """Print the switch point of each phase, and check that it comes `within` this many tasks."""
    assert len(records) == TASKS * len(PHASES)
    points = []
    for n, (failing, best) in enumerate(PHASES):
        used = [record.used for record in records[n * TASKS : (n + 1) * TASKS]]
        points.append(switch_point(used, best))
        print(f"failing: {' and '.join(failing) or 'nothing'}; used: {best} from task {points[-1]} on")
    assert all(point is not None and point <= within for point in points), points
