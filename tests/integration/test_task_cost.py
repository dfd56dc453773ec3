"""An empty remote task takes as many instructions of the processor as it is known to take."""

import platform
import sys

import pytest

from benchmarks import task_cost
from benchmarks.task_cost import ROBOT, SERVER

pytestmark = pytest.mark.integration

# Counted with `python -m benchmarks task_cost`. The interpreters of other versions do other work.
PYTHON, MACHINE = (3, 11), "x86_64"
KNOWN = {ROBOT: 1.20, SERVER: 0.64}  # times the instructions of a fixed piece of Python
MAY_DIFFER = 0.1


@pytest.fixture(scope="module")
def reference() -> float:
    """The instructions of the fixed piece of Python."""
    why = task_cost.why_not()
    if why is None and (sys.version_info[:2] != PYTHON or platform.machine() != MACHINE):
        why = f"the known counts are those of Python {PYTHON[0]}.{PYTHON[1]} on {MACHINE}"
    if why is not None:
        pytest.skip(why)
    return task_cost.of_reference()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("side", task_cost.SIDES)
def test_an_empty_remote_task_takes_known_instructions(reference: float, side: str) -> None:
    """If this fails, the change made tasks dearer, or cheaper: then correct the known count."""
    counted = task_cost.instructions(side) / reference
    assert counted == pytest.approx(KNOWN[side], rel=MAY_DIFFER)
