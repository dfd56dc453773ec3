"""Measures tasks after a run: each onboard alone, in the cloud alone, and on both sites at once.

The times say how much the two executions of one task disturb each other; `loadgen table` reads them.
"""

from collections.abc import Callable
from functools import partial

from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.trace import Record
from offboard.robot_client.simulated.config import RobotConfig
from offboard.robot_client.simulated.references import orders
from offboard.robot_client.simulated.summary import describe, show_progress
from offboard.robot_client.simulated.work import Work
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

WAYS = (ONBOARD, CLOUD, BOTH)


def measure_alone(config: RobotConfig, work: Work, offload: Offloader, say: Callable[[str], None]) -> None:
    """Run `config.alone` further tasks in all WAYS, one way after the other, in an order that changes.

    The only sites of `offload` are onboard and cloud.
    """
    whole = 0
    for number, order in enumerate(orders(config.alone, config.seed, WAYS)):
        request, ran = work.request(), 0
        for n, way in enumerate(order, 1):
            answer = offload(work.function, *request, where=way)
            record = offload.last
            assert record is not None
            ran += _ran(record, way)
            show_progress(number * len(WAYS) + n, config.alone * len(WAYS), partial(describe, record))
        work.advance(answer)
        whole += ran == len(WAYS)
    missing = f"; the {CLOUD} did not answer for the others" if whole < config.alone else ""
    say(f"run on each site alone and on both at once: {whole} of {config.alone} {work.noun}{missing}")


def _ran(record: Record, way: str) -> bool:
    """Whether the task ran well on the sites of `way`, and on no other."""
    sites = [ONBOARD, CLOUD] if way == BOTH else [way]
    return sorted(one.site for one in record.executions if one.ok) == sorted(sites)
