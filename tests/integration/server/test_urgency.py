"""Requests whose answers become useless: refused while their robot can still do something else."""

import pytest

from benchmarks.servers import cloud_server
from offboard import DeadlineMissed, Offloader
from tests.probes import nap

pytestmark = pytest.mark.integration

START_S = 20.0
NAP_S, SHORT_S, LONG_S = 0.3, 0.1, 5.0


def test_what_cannot_be_ready_is_refused_at_once() -> None:
    """Once the server knows how long the task takes; the record says why the server did not run it."""
    with (
        cloud_server("tests.probes", CLOUD_WORKERS="1") as server,
        Offloader.connect(server.endpoint, policy="cloud") as offload,
    ):
        assert offload.wait_for_sites(nap, START_S) == {}
        offload.call(nap, NAP_S, where="cloud", deadline_s=LONG_S)
        with pytest.raises(DeadlineMissed) as missed:
            offload.call(nap, NAP_S, where="cloud", deadline_s=SHORT_S)
        _, record = offload.call(nap, NAP_S, where="cloud", deadline_s=LONG_S)
    assert missed.value.record is not None
    (refused, *_) = missed.value.record.executions
    assert (refused.site, refused.started) == ("cloud", False)
    assert str(refused.error).startswith("CloudBusy: its answer would come after")
    assert record.used == "cloud", "a later deadline is taken"


def test_a_short_run_is_not_refused_because_others_were_long() -> None:
    """The server does not know how long this one takes, so it believes the shortest one."""
    with (
        cloud_server("tests.probes", CLOUD_WORKERS="1") as server,
        Offloader.connect(server.endpoint, policy="cloud") as offload,
    ):
        assert offload.wait_for_sites(nap, START_S) == {}
        for seconds in (NAP_S / 30, NAP_S, NAP_S, NAP_S):
            offload.call(nap, seconds, where="cloud", deadline_s=LONG_S)
        _, record = offload.call(nap, NAP_S / 30, where="cloud", deadline_s=0.8 * NAP_S)
        assert record.used == "cloud"
