"""Real servers that come and go while tasks run, listed in a file that is rewritten."""

import logging
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks.keyring import Keys
from offboard.common.security.keys import read_public
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import ONBOARD
from tests import slow_site
from tests.curves import WAIT_S, Served, until
from tests.namespaces import run_alone

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

TASKS, CHANGES, WITHIN = 2_000, 50, 30
SERVERS = ("a", "b", "c", "d")
LISTS = (("a",), ("b",), ("b", "c"), ("d",), ("c", "d"))  # in turn
ROUNDS, ONBOARD_TIMES = 40_000, 6
FAST = Settings(reread_s=0.1)
ROBOT = "arm"


class Fleet:
    """Servers with a key each, one robot that all of them know, and the file that lists them."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.path = folder / "sites.toml"
        own = Keys(folder / "robot")
        self.keys = own.make(ROBOT)
        (self.keys / "server.key").unlink()  # so that each server must have the key of its entry
        self.entries = {}
        for name in SERVERS:
            keys = Keys(folder / name)
            (keys.robots / "arm.key").write_bytes((self.keys / "robot.key").read_bytes())
            served = Served("--keys", str(keys.server), "--tasks", "tests.slow_site", "--workers", "1")
            stack.callback(served.close)
            key = read_public(keys.server / "server.key").decode()
            self.entries[name] = (served.endpoint, key)

    def text(self, *names: str, more: str = "") -> str:
        entries = ((name, *self.entries[name]) for name in names)
        return "".join(f'[{n}]\nendpoint = "{at}"\nkey = "{key}"\n{more}\n' for n, at, key in entries)

    def write(self, text: str) -> None:
        """Replace the file in one step."""
        fresh = self.path.with_suffix(".new")
        fresh.write_text(text)
        fresh.replace(self.path)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with ExitStack() as stack:
        yield Fleet(tmp_path_factory.mktemp("fleet"), stack)


@pytest.fixture(autouse=True)
def slow_onboard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slow_site, "times", ONBOARD_TIMES)


def test_no_task_is_lost_while_the_file_changes(fleet: Fleet) -> None:
    """2,000 tasks are answered while the file changes 50 times, half of the times torn in the middle.

    A server that the robot never met, or a list without a server that it had, is used within 30 tasks. No
    server that left is used after 30 tasks. One that returns next to an equally good one need not be used.
    """
    records = list[Record]()
    fleet.write(fleet.text(*LISTS[-1]))
    expected = slow_site.hash_slowly(ROUNDS)
    with Offloader.connect(
        sites=fleet.path, keys=fleet.keys, settings=FAST, observers=[records.append]
    ) as offload:
        assert offload.wait_for_sites(slow_site.hash_slowly, WAIT_S) == {}
        for change in range(CHANGES):
            text = fleet.text(*LISTS[change % len(LISTS)])
            if change % 2:
                fleet.path.write_text(text[: len(text) // 2])
                for _ in range(3):
                    assert offload(slow_site.hash_slowly, ROUNDS) == expected
            fleet.write(text)
            while len(records) < (change + 1) * TASKS // CHANGES:
                assert offload(slow_site.hash_slowly, ROUNDS) == expected
    assert len(records) == TASKS
    used = [{one.site for one in record.executions} for record in records]
    each, late, met = TASKS // CHANGES, [], set(LISTS[-1])
    for change in range(CHANGES):
        listed = set(LISTS[change % len(LISTS)])
        new = listed - met or listed - set(LISTS[(change - 1) % len(LISTS)])
        stays = not listed - met and new != listed
        met |= listed
        began = change * each + (3 if change % 2 else 0)
        first = [n for n in range(began, (change + 1) * each) if used[n] & new]
        late += [] if stays else [first[0] - began if first else each]
        after = set().union(*used[began + WITHIN : (change + 1) * each])
        assert after <= listed | {ONBOARD}, f"change {change}: {after} used, {listed} listed"
    assert max(late) <= WITHIN, late


def test_a_server_with_another_key_is_never_used(fleet: Fleet) -> None:
    """A server whose key is not that of its entry gets no task; with the right key it is used."""
    right, wrong = fleet.entries["a"], fleet.entries["b"][1]
    fleet.write(fleet.text("a").replace(right[1], wrong))
    records = list[Record]()
    with Offloader.connect(
        sites=fleet.path, keys=fleet.keys, settings=FAST, observers=[records.append]
    ) as offload:
        until(lambda: "key" in str(offload.wait_for_sites(slow_site.hash_slowly, 0.01)))
        for _ in range(5):
            offload(slow_site.hash_slowly, ROUNDS)
        assert {one.site for record in records for one in record.executions} == {ONBOARD}
        fleet.write(fleet.text("a"))
        until(lambda: offload.wait_for_sites(slow_site.hash_slowly, 0.1) == {} and used(offload) == "a")


def test_a_broken_file_keeps_the_servers_and_is_logged_once(
    fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    """The servers stay in use, one warning names the file, and a corrected file is used again."""
    fleet.write(fleet.text("a"))
    with Offloader.connect(sites=fleet.path, keys=fleet.keys, settings=FAST) as offload:
        assert offload.wait_for_sites(slow_site.hash_slowly, WAIT_S) == {}
        with caplog.at_level(logging.WARNING):
            fleet.write("[a]\nendpoint = 5\n")
            until(lambda: caplog.records)
            time.sleep(5 * FAST.reread_s)
        assert len(caplog.records) == 1
        assert "endpoint 5 must be a string" in caplog.text
        until(lambda: used(offload) == "a")
        fleet.write(fleet.text("b"))
        until(lambda: used(offload) == "b")


def test_equal_servers_are_learnt_from_one_of_them(fleet: Fleet) -> None:
    """Of four servers of a group, one is warmed up; the others are known without a run."""
    fleet.write(fleet.text(*SERVERS, more='group = "planners"'))
    records = list[Record]()
    with Offloader.connect(
        sites=fleet.path, keys=fleet.keys, settings=FAST, observers=[records.append]
    ) as offload:
        assert offload.wait_for_sites(slow_site.hash_slowly, WAIT_S) == {}
        for _ in range(10):
            offload(slow_site.hash_slowly, ROUNDS)
        expected = offload.expect(slow_site.hash_slowly, ROUNDS)
        offload(slow_site.hash_slowly, ROUNDS, where="planners")
    assert expected.keys() == {ONBOARD, *(f"planners/{name}" for name in SERVERS)}
    assert all(one.seconds is not None for one in expected.values())
    assert len({one.site for record in records[:6] for one in record.executions}) == 2
    assert records[-1].used is not None
    assert records[-1].used.startswith("planners/")


def test_a_name_is_a_group_with_a_server_at_each_address(fleet: Fleet) -> None:
    """The resolver of this computer answers for localhost; the key of the group is in its file."""
    at, key = fleet.entries["a"]
    folder = fleet.path.parent
    shutil.copy(fleet.keys / "robot.key_secret", folder)  # with its mode
    (folder / "planners.key").write_text(f'metadata\ncurve\n    public-key = "{key}"\n')
    sites = {"planners": at.replace("tcp://127.0.0.1", "dns://localhost")}
    with Offloader.connect(sites=sites, keys=folder, settings=FAST) as offload:
        assert offload.wait_for_sites(slow_site.hash_slowly, WAIT_S) == {}
        assert set(offload.expect(slow_site.hash_slowly, ROUNDS)) == {ONBOARD, "planners/127.0.0.1"}
        offload(slow_site.hash_slowly, ROUNDS, where="planners")
        assert offload.last is not None
        assert offload.last.used == "planners/127.0.0.1"


def test_the_servers_of_a_name_follow_its_addresses() -> None:
    """An address that is added becomes a site, and one that is removed is none; real names, real servers."""
    found = run_alone("tests.name_changes", timeout_s=150.0)
    one, two = "planners/127.0.0.1", "planners/127.0.0.2"
    assert found["seen"] == [[ONBOARD, one], [ONBOARD, one, two], [ONBOARD, two]]
    assert found["used"] == two


def used(offload: Offloader) -> str | None:
    offload(slow_site.hash_slowly, ROUNDS)
    assert offload.last is not None
    return offload.last.used
