"""The content of a memory file: it is bounded, and a bad file is set aside as a whole."""

import json
import logging
import tracemalloc
from pathlib import Path
from random import Random

import pytest

from offboard.robot_client.learning import store
from offboard.robot_client.predictors.base import REMEMBERED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.memory_robot import Robot, store_plain, store_worked


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def test_the_file_is_bounded(robot: Robot) -> None:
    """It holds the last REMEMBERED observations of each site, and as many sizes with their work."""
    with robot.started("parts") as offload:
        robot.ask(offload, 2 * REMEMBERED, store_worked)
    kind = json.loads(robot.path.read_bytes())["kinds"]["store_worked"]
    assert len(kind["worked"]) == REMEMBERED
    assert [len(site["observations"]) for site in kind["sites"].values()] == [REMEMBERED] * 2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "not JSON"),
        (b'{"v":2,"kinds":{"store_plain":{"sou', "not JSON"),
        (b"\x00\xff\x00", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1, 2]", "not a memory file of a robot-client"),
        (b'{"name": "small"}', "not a memory file of a robot-client"),
        (
            b'{"v": 3, "software": "9.0", "kinds": {}}',
            "format version 3 of software '9.0'; this version reads 2",
        ),
        (
            b'{"v": 1, "software": "0.9", "kinds": {}}',
            "format version 1 of software '0.9'; this version reads 2",
        ),
        (b'{"v": 2, "kinds": []}', "AttributeError"),
        (b'{"v": 2, "kinds": {"store_plain": {}}}', "KeyError: 'per'"),
        (
            b'{"v":2,"kinds":{"a":{"source":"","per":"work","worked":[[1,NaN]],"sites":{}}}}',
            "nan where 0 or a number",
        ),
        (
            b'{"v":2,"kinds":{"a":{"source":"","per":"work","worked":[[1,true]],"sites":{}}}}',
            "True where a number",
        ),
        (b'{"v":2,"kinds":{"a":{"source":"","per":"ell","worked":[],"sites":{}}}}', "per 'ell'"),
    ],
)
def test_a_file_that_cannot_be_read_is_renamed(
    robot: Robot, caplog: pytest.LogCaptureFixture, text: bytes, reason: str
) -> None:
    """A torn, foreign, older or newer file gives one warning that says why, and a cold start."""
    robot.path.write_bytes(text)
    with robot.started() as offload:
        assert offload(store_plain, 2.0) == 2.0
    (warning,) = (one for one in caplog.records if one.levelno == logging.WARNING)
    assert reason in warning.getMessage()
    assert str(robot.path) in warning.getMessage()
    assert "\n" not in warning.getMessage()
    aside = robot.path.with_name("memory.json.unreadable")
    assert aside.read_bytes() == text
    assert json.loads(robot.path.read_bytes())["v"] == 2


def test_only_the_first_bad_file_is_kept(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    """A second bad file is replaced, and the warning says so."""
    aside = robot.path.with_name("memory.json.unreadable")
    for text in (b"first", b"second"):
        robot.path.write_bytes(text)
        robot.started().close()
    assert aside.read_bytes() == b"first"
    assert f"it will be replaced: {aside} is there already" in caplog.text


@pytest.mark.parametrize("at", ["seconds", "amount", "size"])
def test_one_bad_number_makes_the_file_unreadable(
    robot: Robot, caplog: pytest.LogCaptureFixture, at: str
) -> None:
    """The whole file is checked before anything is recalled, so no memory is half of one."""
    with robot.started() as offload:
        robot.ask(offload, 20)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["sites"][CLOUD]["observations"][-1][at] = -1.0
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s is None
    assert "-1.0 where 0 or a number from 1e-50 to 1e+50 was expected" in caplog.text


FIELDS = ("size", "amount", "work", "seconds", "predicted_s", "waited_s", "bytes_out", "bytes_in", "cpu_s")
FIELDS += ("run_s", "queue_s", "round_trip_s", "queue", "load", "wait_s", "capacity", "server_load")


def spoil(robot: Robot, name: str, value: float) -> None:
    """Put this value in every observation of both sites."""
    whole = json.loads(robot.path.read_bytes())
    for site in whole["kinds"]["store_plain"]["sites"].values():
        for one in site["observations"]:
            (one if name in one else one["condition"])[name] = value
    robot.path.write_text(json.dumps(whole))


@pytest.mark.parametrize("name", FIELDS)
def test_a_number_that_no_robot_writes_makes_the_file_unreadable(
    robot: Robot, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """A whole number of 400 digits, a time of 5e-324 s or of 1e300 s: one short warning, and a cold start."""
    for predictor in ("parts", "least-squares"):
        for value in (10**399, 5e-324, 1e-200, 1e300):
            if name == "predicted_s" and value < 1:
                continue  # a prediction may be as short as it likes
            robot.path.unlink(missing_ok=True)
            with robot.started(predictor) as offload:
                robot.ask(offload, 20)
            spoil(robot, name, value)
            caplog.clear()
            with robot.started(predictor) as offload:
                assert robot.outlooks(offload)[ONBOARD].predicted_s is None
                robot.ask(offload, 5)
            (warning,) = (one for one in caplog.records if one.levelno == logging.WARNING)
            assert "where 0 or a number from " in warning.getMessage()
            assert len(warning.getMessage()) < 500


@pytest.mark.parametrize("name", ["size", "seconds", "predicted_s", "waited_s", "bytes_out", "run_s"])
@pytest.mark.parametrize("policy", ["paper", "default"])
def test_the_largest_and_smallest_numbers_that_are_read_do_no_harm(
    robot: Robot, name: str, policy: str
) -> None:
    """The robot answers each call, whatever it recalls."""
    for predictor in ("parts", "least-squares"):
        for value in (1e-50, 1e50, 0.0):
            robot.path.unlink(missing_ok=True)
            with robot.started(predictor) as offload:
                robot.ask(offload, 20)
            spoil(robot, name, value)
            with robot.started(predictor, policy) as offload:
                assert robot.outlooks(offload)[ONBOARD].predicted_s is not None
                robot.ask(offload, 5)
                assert [offload(store_plain, 2.0) for _ in range(10)] == [2.0] * 10


@pytest.mark.parametrize("capacity", [0.0, 1.5])
def test_a_capacity_outside_0_to_1_makes_the_file_unreadable(
    robot: Robot, caplog: pytest.LogCaptureFixture, capacity: float
) -> None:
    """Times are divided by the capacity, so it must be above 0 and at most 1."""
    with robot.started() as offload:
        robot.ask(offload, 20)
    whole = json.loads(robot.path.read_bytes())
    whole["kinds"]["store_plain"]["sites"][ONBOARD]["observations"][-1]["condition"]["capacity"] = capacity
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s is None
    assert f"{capacity} where a share above 0 to 1 was expected" in caplog.text


@pytest.mark.parametrize("name", ["run_s", "queue_s", "bound", "condition"])
def test_a_missing_field_makes_the_file_unreadable(
    robot: Robot, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """Every field of an observation is needed to learn it again; the warning names the missing one."""
    with robot.started() as offload:
        robot.ask(offload, 20)
    whole = json.loads(robot.path.read_bytes())
    del whole["kinds"]["store_plain"]["sites"][CLOUD]["observations"][3][name]
    robot.path.write_text(json.dumps(whole))
    with robot.started() as offload:
        assert robot.outlooks(offload)[ONBOARD].predicted_s is None
    assert f"KeyError: '{name}'" in caplog.text


def test_a_file_that_is_too_large_is_not_read(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    """A sparse file of 1 GiB is renamed, and at most FILE_BYTES_MAX of it are read."""
    with robot.path.open("wb") as file:
        file.truncate(2**30)
    tracemalloc.start()
    robot.started().close()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * store.FILE_BYTES_MAX
    assert f"over {store.FILE_BYTES_MAX} bytes" in caplog.text


def test_a_damaged_file_never_stops_the_robot(robot: Robot) -> None:
    """If any one byte of a good file is changed, the robot still starts and answers."""
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
