"""Fixtures that make real parts and end them."""

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from offboard.robot_client.offloader import Offloader

ROOT = Path(__file__).parents[1]
# The compiled planner is kept beside the checkout, as `make` does it.
os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / ".cache" / "numba"))
# A shell's background job ignores Ctrl-C, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
# How long an example takes depends on the machine. The limit of a test ends one that hangs.
settings.register_profile("offboard", deadline=None)
settings.load_profile("offboard")

PROBES = {"tasks": "tests.probes", "workers": 1}


@pytest.fixture
def testbed(tmp_path: Path) -> Iterator[Callable[..., LocalTestbed]]:
    """Makes started testbeds: a real server and a real relay on loopback, without delay unless asked for.

    The server's flags are the first argument, the link's conditions are named.
    """
    made: list[LocalTestbed] = []

    def factory(cloud: Mapping[str, Any] | None = None, **link: Any) -> LocalTestbed:
        conditions = {"delay_ms": 0.0, "bandwidth_mbps": 0.0} | link
        setups = {"cloud": Setup(PROBES | dict(cloud or {})), "wan": Setup(conditions)}
        bed = LocalTestbed(tmp_path, setups)
        bed.__enter__()
        made.append(bed)
        bed.start()
        return bed

    yield factory
    for bed in made:
        bed.__exit__(None, None, None)


@pytest.fixture
def connect() -> Iterator[Callable[..., Offloader]]:
    """Makes offloaders that are connected to a testbed's relay."""
    made: list[Offloader] = []

    def factory(bed: LocalTestbed, **options: Any) -> Offloader:
        from tests.probes import echo

        made.append(Offloader.connect(bed.endpoint, **options))
        assert made[-1].wait_for_sites(echo, 10.0) == {}
        return made[-1]

    yield factory
    for offload in made:
        offload.close()
