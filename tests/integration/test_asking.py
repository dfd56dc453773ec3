"""Questions, deadlines and observing with a real server: the example of the page, an outage, a saving."""

import queue
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from statistics import fmean

import pytest

from offboard import DeadlineMissed, Offloader
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests import slow_site
from tests.integration.test_own_task import server
from tests.probes import nap

pytestmark = [pytest.mark.integration, pytest.mark.timeout(150)]

PAGE = (Path(__file__).parents[2] / "docs" / "own_task.md").read_text(encoding="utf-8")
WAIT_S = 20.0
ROUNDS, TIMES = (2_000, 4_000), 30  # of a task; times that work onboard, of one in the cloud
TASKS = 150
TOLERANCE = 0.2  # of the saving: the parts of this test share two cores


def test_the_example_of_the_page_runs(tmp_path: Path) -> None:
    """Its programs ask, submit, meet one deadline and miss another, observe, and cancel."""
    blocks = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE, re.DOTALL))
    (tmp_path / "mydetector.py").write_text(blocks["mydetector.py"])
    with server(tmp_path, "mydetector") as (endpoint, _):
        said = {}
        for name in ("ask.py", "cancel.py"):
            (tmp_path / name).write_text(blocks[name].replace("tcp://127.0.0.1:5555", endpoint))
            done = subprocess.run(
                [sys.executable, name], cwd=tmp_path, capture_output=True, text=True, timeout=120
            )
            assert done.returncode == 0, done.stderr
            print(done.stdout)
            said[name] = done.stdout.splitlines()
    new, old = said["cancel.py"]
    assert new.startswith("{'class': ")
    assert re.search(r"cancelled after [\d.]+ m?s, with .* under way$|^it had not begun$|^{'class': ", old)
    cloud, onboard, submitted, in_time, missed, saved = said["ask.py"]
    time_said = r"[\d.]+ m?s \[(up to|[\d.]+,) [\d.]+\], in time with \d+%"
    assert re.fullmatch(f"cloud {time_said}", cloud)
    assert re.fullmatch(f"onboard {time_said}", onboard)
    assert submitted == in_time
    assert submitted.startswith("{'class': ")
    expected = rf"task detect: no answer within 0.001 s; expected: cloud {time_said}; .* [\d.]+"
    assert re.fullmatch(expected, missed)
    assert re.match(r"detect (None|-?[\d.]+ m?s per task \[.* tasks would be sent, \d+ were measured)", saved)


def test_a_call_misses_its_deadline_in_an_outage_and_is_answered_onboard_later(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader], tmp_path: Path
) -> None:
    """The caller goes on at the deadline; the run in the cloud times out, and then onboard answers."""
    records: queue.SimpleQueue[Record] = queue.SimpleQueue()
    bed, path = testbed(), tmp_path / "trace.jsonl"
    with connect(bed, timeout_s=1.0, observers=[records.put], trace=path) as offload:
        for _ in range(12):
            assert offload(nap, 0.001, where=CLOUD, deadline_s=WAIT_S) == 0.001
            records.get(timeout=WAIT_S)
        expected = offload.expect(nap, 0.001, deadline_s=WAIT_S)[CLOUD]
        assert expected.in_time is not None
        assert expected.in_time > 0.9
        bed.set_link(outage=True)
        began_s = time.monotonic()
        with pytest.raises(DeadlineMissed) as missed:
            offload(nap, 0.001, where=CLOUD, deadline_s=0.3)
        waited_s = time.monotonic() - began_s
        print(f"waited {waited_s:.3f} s: {missed.value}")
        assert 0.3 <= waited_s < 0.9
        assert missed.value.expected[CLOUD].seconds is not None
        record, by_then = records.get(timeout=WAIT_S), missed.value.record
    assert (by_then.id, by_then.used, by_then.missed_deadline) == (record.id, None, True)
    assert [one.site for one in by_then.executions] == [CLOUD]
    assert by_then.happened.startswith("cloud had not answered after 3")
    assert (record.used, record.deadline_s, record.missed_deadline) == (ONBOARD, 0.3, True)
    assert [one.site for one in record.executions] == [CLOUD, ONBOARD]
    last = list(read_trace(path))[-1]
    assert last["deadline_s"] == 0.3
    assert last["waited_s"] > 1.0


def test_the_saving_of_a_faster_server_is_estimated(
    testbed: Callable[..., LocalTestbed],
    connect: Callable[..., Offloader],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Every answer comes from onboard, and the estimate is near what the same tasks take in the cloud."""
    monkeypatch.setattr(slow_site, "times", TIMES)
    bed, random, saved_s = testbed({"tasks": "tests.slow_site,tests.probes"}), Random(1), []
    path = tmp_path / "trace.jsonl"
    with connect(bed, observe=True, trace=path) as offload, connect(bed, policy=CLOUD) as sending:
        for _ in range(TASKS):
            rounds = random.randint(*ROUNDS)
            answer = offload(slow_site.hash_slowly, rounds)
            assert offload.last is not None
            assert offload.last.used == ONBOARD
            assert sending(slow_site.hash_slowly, rounds) == answer
            assert sending.last is not None
            saved_s.append(offload.last.waited_s - sending.last.waited_s)
        found = offload.savings()["hash_slowly"]
    true_s = fmean(saved_s)
    print(f"true saving {1e3 * true_s:.2f} ms, estimated {found}")
    assert found is not None
    assert found.mean_s == pytest.approx(true_s, rel=TOLERANCE)
    assert found.sent > 0.9
    last = list(read_trace(path))[-1]
    assert 10 <= last["savings"]["probes"] <= found.probes
    assert last["decision"]["advised"] == CLOUD
