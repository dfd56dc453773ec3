"""The memory file: what was learnt comes back, fades with the time away, and never costs an answer."""

import json
import logging
import os
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from offboard.common.errors import CloudTimeout, ConfigError, TaskFailed
from offboard.common.tasks import Task, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning import store
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.site import OBSERVATIONS_MAX
from offboard.robot_client.learning.store import HALF_LIFE_S, SAVE_EVERY_S, Store
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Outlook, Probe
from offboard.robot_client.policies.probe import STALE
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.records.trace import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.virtual import VirtualClock

EDGE = "edge"
ASKED = 3.0


@task("store_worked", size=lambda size: size, work=lambda result: result["work"])
def store_worked(size: float) -> dict[str, float]:
    return {"work": 10.0 * size}


@task("store_plain", size=lambda size: size)
def store_plain(size: float) -> float:
    return size


class Robot:
    """One robot over several processes: its file, its calendar, and its sites' times from a seed."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "memory.json"
        self.unix_s = 1.7e9
        self.clock = VirtualClock()
        self.random = Random(1)
        self.windows: list[LeastSquares] = []
        self.sites = [self._site(ONBOARD), self._site(CLOUD)]
        self.records: list[Record] = []

    def _site(self, name: str) -> ScriptedRunner:
        def script(one: Task) -> Execution:
            if one.size == ASKED:
                return Execution(name, 0.0, failure=TaskFailed("this size is only for asking what is known"))
            seconds = 0.1 + 0.05 * one.size * self.random.uniform(0.9, 1.1)
            return Execution(name, seconds, one.kind.function(*one.args), bytes_out=100, cpu_s=0.01)

        runner = ScriptedRunner(name, script)
        runner.measured = (
            Condition(round_trip_s=0.02, queue=1, server_load=0.2)
            if name != ONBOARD
            else Condition(load=0.4, capacity=0.5)
        )
        return runner

    def started(
        self,
        predictor: str = predictors.LEAST_SQUARES,
        policy: str = "paper",
        window: int = 50,
        **options: Any,
    ) -> Offloader:
        self.windows = []
        plain = predictor.removeprefix(predictors.WORK)

        def remember() -> predictors.Predictor:
            made = predictors.make(plain, window)
            if isinstance(made, LeastSquares):
                self.windows.append(made)
            return made

        return Offloader(
            self.sites,
            policy=policies.make(policy, 1),
            memories=Memories(
                remember,
                shared_work=plain != predictor,
                store=Store(self.path, now=lambda: self.unix_s),
            ),
            clock=self.clock,
            observers=[self.records.append],
            **options,
        )

    def ask(self, offload: Offloader, tasks: int, function: Callable[[float], Any] = store_plain) -> None:
        for _ in range(tasks):
            offload(function, self.random.uniform(1, 5), where="both")

    def outlooks(
        self, offload: Offloader, function: Callable[[float], Any] = store_plain
    ) -> dict[str, Outlook]:
        """What is known before a task, which teaches nothing itself."""
        with pytest.raises(TaskFailed):
            offload(function, ASKED, where=ONBOARD)
        return dict(self.records[-1].sites)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


@pytest.mark.parametrize(
    "name", ["least-squares", "average", "work:average", "kalman", "features:clipped-least-squares"]
)
def test_a_restart_at_once_predicts_the_same(robot: Robot, name: str) -> None:
    """Predictions, intervals, bytes and joules are equal, to 1e-9, whatever the predictor."""
    with robot.started(name) as offload:
        robot.ask(offload, 150, store_worked)
        before = robot.outlooks(offload, store_worked)
    after = robot.outlooks(robot.started(name), store_worked)
    for site in (ONBOARD, CLOUD):
        for field in (
            "predicted_s",
            "spread_s",
            "low_s",
            "high_s",
            "bytes",
            "joules",
            "cost",
            "observations",
            "full",
        ):
            one, other = getattr(before[site], field), getattr(after[site], field)
            assert one is not None
            assert other == pytest.approx(one, rel=1e-9), (site, field)


@pytest.mark.parametrize("away_s", [0.0, 60.0, -1e6])
def test_the_published_rule_starts_with_its_window(robot: Robot, away_s: float) -> None:
    """After a short time away, or a clock set back, both queues hold exactly what they held."""
    with robot.started(window=50) as offload:
        robot.ask(offload, 120)
        before = [list(one.window) for one in robot.windows]
    robot.unix_s += away_s
    with robot.started(window=50) as offload:
        offload(store_plain, 2.0)
        assert not robot.records[-1].decision.both
        assert [one.full for one in robot.records[-1].sites.values()] == [True, True]
        ran = [run.site for run in robot.records[-1].executions]
        for site, window, old in zip((ONBOARD, CLOUD), robot.windows, before, strict=True):
            assert list(window.window)[: 49 if site in ran else 50] == old[1 if site in ran else 0 :]


@pytest.mark.parametrize(
    ("half_lives", "kept"), [(0.0, 200), (1.0, 100), (2.0, 50), (5.0, 7), (6.0, 0), (1e5, 0)]
)
def test_the_time_away_halves_what_is_believed(robot: Robot, half_lives: float, kept: int) -> None:
    """Of each site the newest are learnt again, half as many a half-life; below five none are."""
    with robot.started(window=300) as offload:
        robot.ask(offload, 230)
        newest = [list(one.window)[-kept:] for one in robot.windows] if kept else [[], []]
    robot.unix_s += half_lives * HALF_LIFE_S
    with robot.started(window=300) as offload:
        found = robot.outlooks(offload)
        assert [list(one.window) for one in robot.windows] == newest
        assert found[CLOUD].age == (STALE if kept else 0)


def test_a_probe_comes_soon_after_a_restart(robot: Robot) -> None:
    """The slower site counts as untried for a while: as soon as the allowance permits it is tried."""
    robot.sites[1].script = lambda one: Execution(CLOUD, 0.9, one.size)
    with robot.started("average", "probe:greedy") as offload:
        robot.ask(offload, 60)
    with robot.started("average", "probe:greedy") as offload:
        for _ in range(12):
            offload(store_plain, robot.random.uniform(1, 5))
    assert [one.decision.second for one in robot.records[-12:]].count(Probe(CLOUD)) == 1


def test_any_predictor_learns_from_the_file(robot: Robot) -> None:
    """What one predictor left behind is learnt by every other, per size and per work alike."""
    with robot.started("work:average") as offload:
        robot.ask(offload, 100, store_worked)
    saved = robot.path.read_bytes()
    for name in ("least-squares", "kalman", "work:least-squares", "average", "bayesian-least-squares"):
        robot.path.write_bytes(saved)
        with robot.started(name, "greedy") as offload:
            predicted_s = robot.outlooks(offload, store_worked)[CLOUD].predicted_s
            assert predicted_s == pytest.approx(0.25, rel=0.15), name


def test_times_per_size_teach_no_times_per_work(robot: Robot) -> None:
    """Where results were not asked for their work sites start cold: no time is in a wrong unit."""
    with robot.started("average") as offload:
        robot.ask(offload, 100, store_worked)
    with robot.started("work:average", "greedy") as offload:
        assert robot.outlooks(offload, store_worked)[CLOUD].predicted_s is None


def test_failures_are_remembered_as_failures(robot: Robot) -> None:
    """A site that had failed last when the process ended has failed last when the next one begins."""
    with robot.started() as offload:
        robot.ask(offload, 10)
        answers = robot.sites[1].script
        robot.sites[1].script = lambda _: Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
        robot.ask(offload, 4)
        robot.sites[1].script = answers
    found = robot.outlooks(robot.started())
    assert (found[CLOUD].failures, found[ONBOARD].failures) == (4, 0)


def test_another_source_starts_cold(robot: Robot) -> None:
    """A kind whose function has changed since knows nothing; other kinds do."""
    with robot.started() as offload:
        robot.ask(offload, 20)
        robot.ask(offload, 20, store_worked)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["source"] = "0" * 64
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload, store_plain)[CLOUD].predicted_s is None
        assert robot.outlooks(offload, store_worked)[CLOUD].predicted_s is not None


def test_what_was_not_asked_for_is_kept_and_fades_on(robot: Robot) -> None:
    """Kinds that did not run, and sites that were not there, stay in the file with their own time."""
    with robot.started() as offload:
        robot.ask(offload, 100)
        robot.ask(offload, 100, store_worked)
    before = robot.unix_s
    robot.unix_s += HALF_LIFE_S
    cloud = robot.sites.pop()
    with robot.started() as offload:
        offload(store_plain, 2.0)
    kinds = json.loads(robot.path.read_bytes())["kinds"]
    assert kinds["store_worked"]["sites"][CLOUD]["saved_at"] == before
    assert kinds["store_plain"]["sites"][CLOUD]["saved_at"] == before
    assert kinds["store_plain"]["sites"][ONBOARD]["saved_at"] == robot.unix_s
    robot.unix_s += HALF_LIFE_S
    robot.sites.append(cloud)
    assert robot.outlooks(robot.started())[CLOUD].observations == 25
    assert robot.outlooks(robot.started())[ONBOARD].observations == 26, "50, one more, and an hour"


def test_the_file_is_bounded(robot: Robot) -> None:
    """However many tasks ran, OBSERVATIONS_MAX of each site are in it, and as many sizes with their work."""
    with robot.started("work:average") as offload:
        robot.ask(offload, 2 * OBSERVATIONS_MAX, store_worked)
    kind = json.loads(robot.path.read_bytes())["kinds"]["store_worked"]
    assert len(kind["worked"]) == OBSERVATIONS_MAX
    assert [len(site["observations"]) for site in kind["sites"].values()] == [OBSERVATIONS_MAX] * 2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "not JSON"),
        (b'{"v":1,"kinds":{"store_plain":{"sou', "not JSON"),
        (b"\x00\xff\x00", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1, 2]", "not a memory file of a robot-client"),
        (b'{"name": "small"}', "not a memory file of a robot-client"),
        (
            b'{"v": 2, "software": "9.0", "kinds": {}}',
            "format version 2 of software '9.0'; this version reads 1",
        ),
        (b'{"v": 1, "kinds": []}', "AttributeError"),
        (b'{"v": 1, "kinds": {"store_plain": {}}}', "KeyError: 'per'"),
        (
            b'{"v":1,"kinds":{"a":{"source":"","per":"work","worked":[[1,NaN]],"sites":{}}}}',
            "nan where a finite",
        ),
        (
            b'{"v":1,"kinds":{"a":{"source":"","per":"work","worked":[[1,true]],"sites":{}}}}',
            "True where a number",
        ),
        (b'{"v":1,"kinds":{"a":{"source":"","per":"ell","worked":[],"sites":{}}}}', "per 'ell'"),
    ],
)
def test_a_file_that_is_none_of_ours_is_set_aside(
    robot: Robot, caplog: pytest.LogCaptureFixture, text: bytes, reason: str
) -> None:
    """Torn, foreign or of a later version: one warning with file and reason, a cold start, the file kept."""
    robot.path.write_bytes(text)
    with robot.started() as offload:
        assert offload(store_plain, 2.0) == 2.0
    (warning,) = (one for one in caplog.records if one.levelno == logging.WARNING)
    assert reason in warning.getMessage()
    assert str(robot.path) in warning.getMessage()
    assert "\n" not in warning.getMessage()
    aside = robot.path.with_name("memory.json.unreadable")
    assert aside.read_bytes() == text
    assert json.loads(robot.path.read_bytes())["v"] == 1


def test_a_file_is_set_aside_once(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    """The first one is the one to look at; a second is replaced, and the warning says so."""
    aside = robot.path.with_name("memory.json.unreadable")
    for text in (b"first", b"second"):
        robot.path.write_bytes(text)
        robot.started().close()
    assert aside.read_bytes() == b"first"
    assert f"it will be replaced: {aside} is there already" in caplog.text


@pytest.mark.parametrize("at", ["seconds", "amount", "size"])
def test_one_bad_number_spoils_the_file(robot: Robot, caplog: pytest.LogCaptureFixture, at: str) -> None:
    """It is checked whole before anything is learnt from it: no half of a memory."""
    with robot.started() as offload:
        robot.ask(offload, 20)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["sites"][CLOUD]["observations"][-1][at] = -1.0
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s is None
    assert "-1.0 where a finite number from 0 was expected" in caplog.text


@pytest.mark.parametrize("capacity", [0.0, 1.5])
def test_a_capacity_of_nothing_or_of_more_than_a_cpu_spoils_the_file(
    robot: Robot, caplog: pytest.LogCaptureFixture, capacity: float
) -> None:
    """Times are divided by it."""
    with robot.started() as offload:
        robot.ask(offload, 20)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["sites"][ONBOARD]["observations"][-1]["condition"]["capacity"] = capacity
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s is None
    assert f"{capacity} where a share above 0 to 1 was expected" in caplog.text


def test_a_file_of_before_is_read(robot: Robot) -> None:
    """What a robot learnt does not end with an update: its CPU was whole then."""
    robot.sites[0].measured = UNMEASURED
    with robot.started() as offload:
        robot.ask(offload, 20)
        before = robot.outlooks(offload)
    whole = json.loads(robot.path.read_bytes())
    for site in whole["kinds"]["store_plain"]["sites"].values():
        for one in site["observations"]:
            del one["condition"]["capacity"], one["condition"]["server_load"], one["ahead"]
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s == before[ONBOARD].predicted_s


def test_a_file_too_large_is_not_read(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    """A sparse file of 1 GiB is set aside, and no more of it is read than could be ours."""
    with robot.path.open("wb") as file:
        file.truncate(2**30)
    tracemalloc.start()
    robot.started().close()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * store.FILE_BYTES_MAX
    assert f"over {store.FILE_BYTES_MAX} bytes" in caplog.text


def test_a_kill_while_writing_leaves_the_last_whole_file(robot: Robot) -> None:
    """The torn half is in a file beside it, which nobody reads and the next save replaces."""
    with robot.started() as offload:
        robot.ask(offload, 60)
    torn = robot.path.with_name(".memory.json.new")
    torn.write_bytes(robot.path.read_bytes()[:1000])
    with robot.started() as offload:
        assert robot.outlooks(offload)[CLOUD].observations == 50
    assert not torn.exists()
    assert sorted(one.name for one in robot.path.parent.iterdir()) == ["memory.json"]


def test_a_save_survives_a_loss_of_power(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The new file is on the disk before it gets its name, and the name before the save ends."""
    sync, synced = os.fsync, []

    def note(number: int) -> None:
        synced.append((Path(f"/proc/self/fd/{number}").readlink().name, robot.path.exists()))
        sync(number)

    monkeypatch.setattr(store.os, "fsync", note)
    robot.started().close()
    assert synced == [(".memory.json.new", False), (robot.path.parent.name, True)]


def writers() -> list[threading.Thread]:
    """The threads that write a memory file now."""
    return [thread for thread in threading.enumerate() if thread.name == "memory"]


def wait_for_writers() -> None:
    for writer in writers():
        writer.join(10)


def test_it_is_saved_every_half_minute(robot: Robot) -> None:
    """Not at the first task, but SAVE_EVERY_S after it and again after as long: a crash costs no more."""
    offload = robot.started()
    robot.ask(offload, 5)
    assert not robot.path.exists()
    for observations in (6, 7):
        robot.clock.wait([], SAVE_EVERY_S)
        robot.ask(offload, 1)
        wait_for_writers()
        sites = json.loads(robot.path.read_bytes())["kinds"]["store_plain"]["sites"]
        assert len(sites[CLOUD]["observations"]) == observations
        robot.ask(offload, 0)
    offload.close()


def test_a_slow_disk_keeps_nobody_waiting(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a save hangs tasks are answered, no second one begins; the end writes the last state."""
    hanging, entered = threading.Event(), threading.Event()
    sync = store.os.fsync

    def slow(number: int) -> None:
        entered.set()
        assert hanging.wait(10)
        sync(number)

    monkeypatch.setattr(store.os, "fsync", slow)
    offload = robot.started()
    robot.ask(offload, 1)
    robot.clock.wait([], SAVE_EVERY_S)
    robot.ask(offload, 1)
    assert entered.wait(10)
    (writer,) = writers()
    for _ in range(3):
        robot.clock.wait([], SAVE_EVERY_S)
        robot.ask(offload, 1)
        assert writers() == [writer]
    hanging.set()
    offload.close()
    sites = json.loads(robot.path.read_bytes())["kinds"]["store_plain"]["sites"]
    assert len(sites[CLOUD]["observations"]) == 5


def test_a_disk_that_hangs_for_ever_does_not_hang_the_end(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """close waits so long and no longer, and says what was not written."""
    hanging = threading.Event()
    monkeypatch.setattr(store.os, "fsync", lambda _: hanging.wait(10) and None)
    monkeypatch.setattr(store, "WRITE_WAIT_S", 0.01)
    offload = robot.started()
    robot.ask(offload, 1)
    offload.close()
    assert "not written within 0.01 s" in caplog.text
    hanging.set()
    wait_for_writers()


def test_a_failing_disk_is_one_warning_and_no_lost_answer(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever cannot be written, tasks go on; when the disk is back the file is written again."""
    blocked = robot.path.with_name(".memory.json.new")
    blocked.mkdir()
    offload = robot.started()
    for _ in range(4):
        robot.clock.wait([], SAVE_EVERY_S)
        assert offload(store_plain, 2.0) == 2.0
        wait_for_writers()
    assert [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING] == [
        f"memory {robot.path} cannot be written: Is a directory; tasks go on"
    ]
    blocked.rmdir()
    offload.close()
    assert robot.path.exists()


def test_a_machine_without_threads_to_spare_loses_no_answer(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where no thread can be started the file is not written, and that is said once."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    offload = robot.started()
    offload(store_plain, 2.0)
    monkeypatch.setattr(store.threading.Thread, "start", refuse)
    for _ in range(3):
        robot.clock.wait([], SAVE_EVERY_S)
        assert offload(store_plain, 2.0) == 2.0
    offload.close()
    assert caplog.text.count("can't start new thread") == 1


def test_close_saves_once_and_after_it_nothing_is_saved(robot: Robot) -> None:
    """A second close, and tasks that end later, change nothing in the file."""
    offload = robot.started()
    robot.ask(offload, 3)
    offload.close()
    written = robot.path.stat().st_mtime_ns
    robot.clock.wait([], 10 * SAVE_EVERY_S)
    robot.ask(offload, 3)
    offload.close()
    assert robot.path.stat().st_mtime_ns == written


def test_a_folder_in_the_files_place_is_refused(tmp_path: Path) -> None:
    """A wrong path is said at the start; missing folders are made."""
    with pytest.raises(ConfigError, match=f"memory {tmp_path}: is a folder"):
        Store(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"memory .*: File exists|Not a directory"):
        Store(tmp_path / "file" / "memory.json")
    Store(tmp_path / "a" / "b" / "memory.json")
    assert (tmp_path / "a" / "b").is_dir()


def test_a_random_file_never_stops_the_robot(robot: Robot) -> None:
    """With any byte of a good file changed the robot starts: what is not believed is set aside."""
    with robot.started(window=5) as offload:
        robot.ask(offload, 6)
    good, rng = robot.path.read_bytes(), Random(3)
    for _ in range(300):
        spoilt = bytearray(good)
        spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
        robot.path.write_bytes(spoilt)
        offload = robot.started(window=5)
        assert offload(store_plain, 2.0) == 2.0
        robot.path.with_name("memory.json.unreadable").unlink(missing_ok=True)
