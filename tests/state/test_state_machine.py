"""A robot under abuse, driven by a state machine: a minute in `make test-all`, ten in `make state`."""

import random
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from offboard import Offloader
from offboard.robot_client.sites.runner import CLOUD
from tests.chaos.plays import ALL
from tests.state import served
from tests.state.call_rules import CELLS, CallRules
from tests.state.calls import Tally
from tests.state.process_rules import ProcessRules
from tests.state.server import Server
from tests.state.server_rules import REACH_S, ServerRules

SECONDS = 600 if ALL else 60
SHRINK_S = 600  # if it fails, for the search for fewer steps
RUNS, STEPS = 8, 50  # of one seed

pytestmark = [pytest.mark.integration, pytest.mark.timeout(SECONDS + SHRINK_S)]

search = settings(
    max_examples=RUNS,
    stateful_step_count=STEPS,
    database=None,
    phases=(Phase.generate, Phase.shrink),
    report_multiple_bugs=False,
    print_blob=False,
    suppress_health_check=list(HealthCheck),
)


class Robot(CallRules, ServerRules, ProcessRules):
    """All rules."""


def load_libraries(server: Server) -> None:
    """What a library keeps for good is no leftover: pyzmq keeps a thread once it has sent an array."""
    with Offloader.connect(server.endpoint) as offload:
        assert offload.wait_for_sites(served.weigh, REACH_S) == {}
        offload(served.weigh, np.arange(CELLS), where=CLOUD)


def test_every_call_is_answered_under_abuse(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    """No call is lost, wrong or hung, and no thread, file or socket is left over."""
    given = pytestconfig.getoption("--hypothesis-seed")
    number = int(given) if given else random.randrange(2**32)
    tally, end_s = Tally(), time.monotonic() + SECONDS
    with Server(tmp_path) as server:
        load_libraries(server)
        while time.monotonic() < end_s:
            print(f"--hypothesis-seed={number}")
            run = partial(Robot, server, tmp_path, tally)
            run_state_machine_as_test(seed(number)(run), settings=search)
            number += 1
    print(tally)
