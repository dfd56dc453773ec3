"""Variants with a real server behind a real relay: an outage in the middle, a batch, other source there."""

import os
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard import Offloader, Settings
from offboard.common.tasks import kind_of
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.play.run_files import EVENTS, TRACE
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.scenario.site_shares import read_outage
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.records.record import Record
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
LATE = 2  # answers of the small variant at most, because the cloud was late on a busy machine
WITHIN = 30  # tasks after the outage, within which the better variant must be used again
PAUSE_S = 0.05  # between two tasks
TIMEOUT_S = 1.0
WARM_UP = 6
SERVED = {"tasks": "tests.variant_tasks", "workers": 1}


def test_the_better_variant_is_used_before_and_after_an_outage(testbed: Beds) -> None:
    """Large before, small during the outage, large again within 30 tasks; every call is answered in time."""
    bed, records, answers = testbed(SERVED, delay_ms=15.0), list[Record](), list[str]()
    with Offloader.connect(bed.endpoint, timeout_s=TIMEOUT_S, observers=[records.append]) as offload:
        assert offload.wait_for_sites(grade, CONNECT_S) == {}
        for silent in (False, True, False):
            bed.set_link(outage=silent)
            for number in range(TASKS):
                model, how, echoed, process = offload(grade, number)
                assert (model, how) in (("small", "rough"), ("large", "fine"))
                assert (echoed, process == os.getpid()) == (number, model == "small")
                answers.append(model)
                time.sleep(PAUSE_S)
    before, during, after = (slice(n * TASKS, (n + 1) * TASKS) for n in range(3))
    for phase in (before, during, after):
        print(*map(shown, records[phase]), sep="\n")
    assert answers[before].count("large") >= TASKS - LATE
    assert answers[during] == ["small"] * TASKS
    assert answers[after][WITHIN:].count("small") <= LATE
    assert max(record.waited_s for record in records) < TIMEOUT_S + 1.0


def shown(record: Record) -> str:
    """The site, the quality and the time of an answer."""
    assert record.used is not None
    quality = record.sites[record.used].quality.value
    return f"{record.used} quality {quality} {record.waited_s * 1e3:.0f} ms ({record.decision.reason})"


def test_a_batch_stays_on_the_better_variant(testbed: Beds) -> None:
    """Onboard is free, but an item there would lose more than the cloud's queue costs; warm-up aside."""
    bed, settings = testbed(SERVED, delay_ms=5.0), Settings(s_per_quality=10.0)
    with Offloader.connect(bed.endpoint, settings=settings) as offload:
        assert offload.wait_for_sites(grade, CONNECT_S) == {}
        answers = offload.map(grade, range(30))
        assert [one[2] for one in answers] == list(range(30))
        models = [one[0] for one in offload.map(grade, range(10))]
    assert [one[0] for one in answers].count("small") <= WARM_UP + LATE
    assert models.count("small") <= LATE


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
        f"cloud: {said}: this task stays onboard; remedy: install the same version there, and restart it"
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
    """AprilTags at full size before the outage, in small pictures during it, at full size again after it."""
    pytest.importorskip("pupil_apriltags", reason="needs the extra 'apriltags'")
    from examples.variants import SMALL_QUALITY

    played = play(read_scenario(find_scenario("variants-outage")), tmp_path)
    played.check_robots()
    said = capsys.readouterr().out
    print(said)
    assert [str(one) for one in played.verdicts if not one.holds] == []
    outage = read_outage(tmp_path / EVENTS)
    assert outage is not None
    used = [record["used"] for record in read_trace(tmp_path / TRACE)]
    began, ended = outage
    assert used[began - 8 : began].count(CLOUD) >= 8 - LATE
    assert used[ended - 3 : ended] == [ONBOARD] * 3
    assert CLOUD in used[ended : ended + WITHIN]
    for site, quality in ((ONBOARD, SMALL_QUALITY), (CLOUD, 1)):
        assert re.search(rf"^{site}: \d+ answers of quality {quality:g} after [\d.]+ m?s", said, re.MULTILINE)
