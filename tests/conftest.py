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
pytest.register_assert_rewrite("tests.testbeds")  # its failures show values, as those of test modules
# The compiled planner is kept beside the checkout, as `make` does it.
os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / ".cache" / "numba"))
# A shell's background job ignores Ctrl-C, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
# How long an example takes depends on the machine. The limit of a test ends one that hangs.
settings.register_profile("offboard", deadline=None)
settings.load_profile("offboard")

PROBES = {"tasks": "tests.probes", "workers": 1}
TESTS = Path(__file__).parent
# What `make test` leaves out, and `make test-all` runs: it takes long, or needs other programs.
LONG = (
    *("chaos", "compose", "state"),
    *(f"integration/{name}" for name in ("openpi", "prometheus", "toxiproxy")),
    *(f"integration/keys/test_{name}.py" for name in ("key_changes", "key_commands", "page_examples")),
    *(f"integration/server/test_{name}.py" for name in ("ended_connections", "forked_copies", "live_server")),
    *(
        f"integration/test_{name}.py"
        for name in (
            *("alone", "asking", "attacks", "batch", "changing_sites", "check", "child_processes", "compare"),
            *("cost", "covers", "crashes", "crossing", "dataset", "demo", "examples_run", "export"),
            *("fairness", "faults", "first_calls", "forked_and_dropped", "fuzz", "leftovers", "live_robot"),
            *(
                "load",
                "local_testbed",
                "locked_wheels",
                "make_figures",
                "own_task",
                "packing",
                "recorded_run",
            ),
            *("robot_workload", "scarce", "silent_outage"),
            *("stream_faults", "task_cost"),
            *("terminal", "values_cross", "wan_recording", "watch", "wheel"),
        )
    ),
    *(
        f"unit/test_{name}.py"
        for name in ("ablations", "datasets", "footprint", "report", "report_charts", "search")
    ),
    *("unit/test_simulation_checks.py", "unit/test_simulation_compare.py", "unit/test_simulated_sets.py"),
)
# What measures times that a busy machine would change, or uses all CPUs: no other test runs next to it.
ALONE = (
    "browser",
    "chaos/test_scenarios.py",
    "compose/test_image.py",
    *(
        f"integration/test_{name}.py"
        for name in (
            *("servers_on_loopback", "testbed", "three_sites", "variants"),
            *("wan", "wan_effects", "wan_speed"),
        )
    ),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests as `long` or `alone`."""
    for item in items:
        place = item.path.relative_to(TESTS).as_posix()
        for mark, places in (("long", LONG), ("alone", ALONE)):
            if place.startswith(places):
                item.add_marker(mark)


@pytest.hookimpl(optionalhook=True)  # some environments have no xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Tests of a file share its servers, and those with containers the engine: one process runs them all."""
    if config.getvalue("dist") != "load":  # another way was asked for
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            place = nodeid.partition("::")[0]
            return "engine" if "tests/compose" in place or "docker" in nodeid else place

    return ByFile(config, log)


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
