"""Keys that are added, removed or changed while the server runs (docs/security.md), with real processes."""

import os
import resource
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
import zmq

from benchmarks.keyring import Keys
from offboard.common.security.keys import robot_keys
from offboard.common.wire import messages as wire
from offboard.robot_client.cloud.connection import UNKNOWN_ROBOT
from offboard.robot_client.offloader import Offloader
from tests.curves import WAIT_S, Dealer, until
from tests.integration.keys.servers import Robot, Serve, metric, stays_onboard, why_not
from tests.probes import echo

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]

CUT_S = 5.0  # a robot whose key was removed is cut off within this time
FREE_FILES = 20
FLOOD_S = 4.0  # the server looks at its folder of keys four times
PAUSE_S = 0.002  # between tasks, so that a robot stays within its quota of messages


def test_a_removed_robot_is_cut_off(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Its connection ends within 5 s and its tasks stay onboard, while other robots are still served."""
    served = serve(keys)
    removed, other = (robot(served.endpoint, keys.add(name)) for name in ("removed", "other"))
    for offload in (removed, other):
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        assert offload(echo, 1) == 1
    keys.remove("removed")
    until(lambda: why_not(removed), within_s=CUT_S)
    stays_onboard(removed)
    until(lambda: UNKNOWN_ROBOT in why_not(removed))
    assert served.logged("cut off robot removed") == 1
    assert other(echo, 2) == 2
    assert other.last is not None
    assert other.last.used == "cloud"
    assert other.last.executions[0].ok


def test_a_server_without_a_free_file_keeps_its_robots(keys: Keys, serve: Serve, robot: Robot) -> None:
    """If connections take all files, known robots are served on, and new ones once there are files again."""
    served = serve(keys)
    pid = served.process.pid
    offload, late_key = robot(served.endpoint, keys.add("early")), keys.add("late")
    assert offload.wait_for_sites(echo, WAIT_S) == {}
    limit = FREE_FILES + sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (limit, limit))
    with ExitStack() as flood:
        for _ in range(4 * FREE_FILES):
            flood.enter_context(socket.create_connection(("127.0.0.1", served.port)))
        end_s = time.monotonic() + FLOOD_S
        while time.monotonic() < end_s:
            assert offload(echo, 1) == 1
            assert offload.last is not None
            assert offload.last.used == "cloud", served.lines
            time.sleep(PAUSE_S)
    late = robot(served.endpoint, late_key)
    assert late.wait_for_sites(echo, WAIT_S) == {}
    keys.remove("early")
    until(lambda: why_not(offload), within_s=CUT_S)


def test_a_removed_robot_gets_no_answer(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """Its waiting task never runs, its running task gets no answer, and its connection is closed."""
    mine = robot_keys(keys.add("arm"), "cloud")
    served = serve(keys, "--workers", "1")
    pipe, mark = tmp_path / "pipe", tmp_path / "mark"
    os.mkfifo(pipe)
    with Dealer(served.port, mine.own.public, mine.own.secret, mine.server) as raw:
        assert raw.handshake == zmq.EVENT_HANDSHAKE_SUCCEEDED
        for id, kind, path in ((1, "mark_once", pipe), (2, "mark_once", mark)):
            raw.send(wire.Request(id, kind, WAIT_S, 1, (), wire.encode([str(path)]).frames))
        until(lambda: httpx.get(f"{served.http}/health").json()["queue_depth"] == 1)
        keys.remove("arm")
        assert raw.event(CUT_S) == zmq.EVENT_DISCONNECTED
        assert raw.event() == zmq.EVENT_HANDSHAKE_FAILED_AUTH
        until(lambda: httpx.get(f"{served.http}/health").json()["queue_depth"] == 0)
        with pipe.open() as reader:  # the first task may end now
            assert reader.read()
        until(lambda: httpx.get(f"{served.http}/health").json()["running"] == 0)
        assert not raw.socket.poll(0)
    assert not mark.exists()
    assert metric(served, 'requests_total{kind="mark_once",status="cancelled"}') == 2


def test_a_broken_file_does_not_keep_a_removed_robot_in(keys: Keys, serve: Serve, robot: Robot) -> None:
    """A file that is no key is named in the log once, and the other files still count when they change."""
    served = serve(keys)
    offload = robot(served.endpoint, keys.add("arm"))
    assert offload.wait_for_sites(echo, WAIT_S) == {}
    (keys.robots / "torn.key").write_text("curve\n    public-key = ")
    until(lambda: served.logged("torn.key:2: public-key: not a key"))
    assert why_not(offload) == ""
    keys.remove("arm")
    until(lambda: why_not(offload), within_s=CUT_S)
    assert served.logged("torn.key") == 1


def test_without_its_folder_the_server_knows_nobody(keys: Keys, serve: Serve, robot: Robot) -> None:
    """If the folder of robots is gone, all robots are cut off. They come back with the folder."""
    served = serve(keys)
    offload = robot(served.endpoint, keys.add("arm"))
    assert offload.wait_for_sites(echo, WAIT_S) == {}
    aside = keys.robots.rename(keys.robots.with_name("aside"))
    until(lambda: why_not(offload), within_s=CUT_S)
    stays_onboard(offload)
    aside.rename(keys.robots)
    assert offload.wait_for_sites(echo, WAIT_S) == {}


def test_a_key_is_changed_without_a_lost_task(keys: Keys, serve: Serve, robot: Robot) -> None:
    """The old key is removed while both robots call: no task is lost, and those of the new key run there."""
    served = serve(keys)
    old = robot(served.endpoint, keys.add("old"))
    assert old.wait_for_sites(echo, WAIT_S) == {}
    over = threading.Event()

    def ask(offload: Offloader) -> list[str]:
        used = []
        while not over.is_set():
            assert offload(echo, len(used)) == len(used)
            assert offload.last is not None
            used.append(str(offload.last.used))
            over.wait(PAUSE_S)
        return used

    with ThreadPoolExecutor() as pool:
        try:
            before = pool.submit(ask, old)
            new = robot(served.endpoint, keys.add("new"), timeout_s=WAIT_S)
            assert new.wait_for_sites(echo, WAIT_S) == {}
            after = pool.submit(ask, new)
            keys.remove("old")
            until(lambda: why_not(old), within_s=CUT_S)
        finally:
            over.set()
    assert (before.result()[0], set(after.result())) == ("cloud", {"cloud"})
