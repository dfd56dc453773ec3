"""Variants with a real server behind a real relay: an outage in the middle, a batch, and other source there."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard import Offloader
from offboard.common.tasks import kind_of
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.play.run_files import EVENTS, TRACE
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.outage_recovery import read_outage
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.records.trace import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.variant_tasks import grade, only_there

pytestmark = [
    pytest.mark.integration,
    pytest.mark.timeout(120),
    pytest.mark.filterwarnings("default::DeprecationWarning", "default::SyntaxWarning"),  # of pupil_apriltags
]

Beds = Callable[..., LocalTestbed]
CONNECT_S = 20.0
TASKS = 40  # of each phase
SETTLED = 10  # tasks after a change, before the robot must have noticed it
WITHIN = 30  # tasks after the outage, within which the better variant must be used again
PAUSE_S = 0.05  # between two tasks
TIMEOUT_S = 1.0
WARM_UP = 6
SERVED = {"tasks": "tests.variant_tasks", "workers": 1}


def test_the_better_variant_is_used_before_and_after_an_outage(testbed: Beds) -> None:
    """Large before, small during the outage, large again within 30 tasks; every call is answered in time."""
    bed, records = testbed(SERVED, delay_ms=15.0), list[Record]()

    def ask(tasks: int) -> list[str]:
        answers = []
        for number in range(tasks):
            answers.append(offload(grade, number))
            time.sleep(PAUSE_S)
        assert [one[2] for one in answers] == list(range(tasks))
        assert all((one[3] == os.getpid()) == (one[:2] == ["small", "rough"]) for one in answers)
        return [one[1] for one in answers]

    with Offloader.connect(bed.endpoint, timeout_s=TIMEOUT_S, observers=[records.append]) as offload:
        assert offload.wait_for_sites(grade, CONNECT_S) == {}
        before = ask(TASKS)
        bed.set_link(outage=True)
        during = ask(TASKS)
        bed.set_link(outage=False)
        after = ask(TASKS)
    print("before", before, "during", during, "after", after, sep="\n")
    assert before == ["fine"] * TASKS
    assert during[SETTLED:] == ["rough"] * (TASKS - SETTLED)
    assert after[WITHIN:] == ["fine"] * (TASKS - WITHIN)
    assert max(record.waited_s for record in records) < TIMEOUT_S + 1.0
    chosen = [record.sites[record.used or ONBOARD].quality.value for record in records[TASKS - 5 : TASKS]]
    assert chosen == [1.0] * 5


def test_a_batch_stays_on_the_better_variant(testbed: Beds) -> None:
    """Onboard is free, but an item there would lose more than the cloud's queue costs; warm-up aside."""
    bed = testbed(SERVED, delay_ms=5.0)
    with Offloader.connect(bed.endpoint) as offload:
        assert offload.wait_for_sites(grade, CONNECT_S) == {}
        answers = offload.map(grade, range(30))
        assert [one[2] for one in answers] == list(range(30))
        assert [one[1] for one in offload.map(grade, range(5))] == ["fine"] * 5
    assert [one[1] for one in answers].count("rough") <= WARM_UP


def test_other_source_on_the_server_is_one_line(
    testbed: Beds, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The task stays onboard, with its small variant; the log and `wait_for_sites` name the variant."""
    bed, said = testbed(SERVED), "the source of grade@cloud, a variant of task grade, differs on the server"
    variants = kind_of(grade).variants
    assert isinstance(variants, dict)
    monkeypatch.setitem(variants, CLOUD, replace(variants[CLOUD], source_hash="f" * 64))
    with Offloader.connect(bed.endpoint) as offload:
        assert offload.wait_for_sites(grade, CONNECT_S) == {CLOUD: said}
        assert offload(grade, 3)[:3] == ["small", "rough", 3]
        assert offload.last is not None
        assert offload.last.decision.reason == f"cloud: {said}"
    assert [one.getMessage() for one in caplog.records if "stays onboard" in one.getMessage()] == [
        f"cloud: {said}: this task stays onboard"
    ]


def test_a_server_may_lack_a_variant(testbed: Beds) -> None:
    """Robot and server load the same module here, in which nobody has the variant of the cloud."""
    bed = testbed(SERVED)
    with Offloader.connect(bed.endpoint) as offload:
        absent = offload.wait_for_sites(only_there, CONNECT_S)
        assert absent == {CLOUD: "the server does not have only_there@cloud, a variant of task only_there"}
        assert offload(only_there, 3) == "onboard 3"


def test_the_shipped_scenario_shows_quality_and_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """AprilTags at full size before the outage, at half the size during it, at full size again after it."""
    pytest.importorskip("pupil_apriltags", reason="needs the extra 'apriltags'")
    played = play(read_scenario(find_scenario("variants-outage")), tmp_path)
    played.check_robots()
    said = capsys.readouterr().out
    print(said)
    assert [str(one) for one in played.verdicts if not one.holds] == []
    outage = read_outage(tmp_path / EVENTS)
    assert outage is not None
    used = [record["used"] for record in read_trace(tmp_path / TRACE)]
    began, ended = outage
    assert used[began - 5 : began] == [CLOUD] * 5
    assert used[ended - 3 : ended] == [ONBOARD] * 3
    assert CLOUD in used[ended : ended + WITHIN]
    for site, quality in (("onboard", 0.6), ("cloud", 1)):
        assert f"answers of quality {quality:g} after" in next(
            line for line in said.splitlines() if line.startswith(f"{site}: ")
        )
