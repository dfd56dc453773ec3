"""What keys and tokens keep out: the rows of docs/security.md, against real processes."""

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
import zmq

from benchmarks.keyring import Keys
from offboard.common import VERSION
from offboard.common.security.keys import PRIVATE, make_keys, robot_keys, server_keys
from offboard.common.wire import messages as wire
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.cloud import REFUSED, UNFIT
from tests.curves import ROOT, WAIT_S, Dealer, Served, clean_environ, recorded, says_until_closed, until
from tests.probes import echo, mark_once, nap

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]

CUT_S = 5.0  # a robot that was removed is cut off within
PAUSE_S = 0.002  # between tasks: a robot that asks as fast as it can is over its quota of messages
TOKEN = "a-token-of-the-tests"
SAFE_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "cache-control": "no-store",
}


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path)


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Factory: a server process with these keys and flags."""
    with ExitStack() as stack:

        def start(keys: Keys | None, *flags: str) -> Served:
            served = Served(*(["--keys", str(keys.server)] if keys else []), *flags)
            stack.callback(served.close)
            return served

        yield start


@pytest.fixture
def robot() -> Iterator[Callable[..., Offloader]]:
    """Factory: a robot that sends every task to the cloud; it need not be connected yet."""
    with ExitStack() as stack:

        def connect(endpoint: str, keys: Path | None, **options: Any) -> Offloader:
            return stack.enter_context(Offloader.connect(endpoint, policy="cloud", keys=keys, **options))

        yield connect


Serve = Callable[..., Served]
Robot = Callable[..., Offloader]


def run(*command: str, **environ: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", f"offboard.{command[0]}", *command[1:]],
        cwd=ROOT,
        env=clean_environ() | environ,
        capture_output=True,
        text=True,
        timeout=60,
    )


def token_file(folder: Path) -> Path:
    path = folder / "token"
    path.touch(0o600)
    path.write_text(f"{TOKEN}\n")
    return path


def metric(served: Served, name: str) -> float:
    text = httpx.get(f"{served.http}/metrics").text
    return sum(float(line.split()[-1]) for line in text.splitlines() if line.startswith(f"offboard_{name}"))


def why_not(offload: Offloader) -> str:
    return offload.wait_for_sites(echo, 0.0).get("cloud", "")


def stays_onboard(offload: Offloader) -> None:
    assert offload(echo, "mine") == "mine"
    assert offload.last is not None
    assert offload.last.used == "onboard"


def test_a_robot_that_is_known_is_served(keys: Keys, serve: Serve, robot: Robot) -> None:
    """With keys on both sides tasks run in the cloud, and their arguments cannot be read on the way."""
    folder = keys.add("arm")
    served = serve(keys)
    with recorded(served.port) as way:
        offload = robot(f"tcp://127.0.0.1:{way.port}", folder)
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        assert offload(echo, "a secret of ours") == "a secret of ours"
        assert offload.last is not None
        assert offload.last.used == "cloud"
        offload.close()
        assert b"CURVE" in way.said
        assert b"echo" not in way.said
        assert b"a secret of ours" not in way.said


def test_a_robot_without_keys_is_not_served(keys: Keys, serve: Serve, robot: Robot) -> None:
    """No key: the handshake fails, the robot's tasks stay onboard, and the server reads nothing of it."""
    served = serve(keys)
    offload = robot(served.endpoint, None)
    until(lambda: UNFIT in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "bytes_in_total") == 0


def test_a_robot_that_is_not_known_is_refused(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Wrong key: refused, said on both sides and counted; once its key is there it is served."""
    served = serve(keys)
    offload = robot(served.endpoint, keys.make("stranger"))
    until(lambda: REFUSED in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "refused_total") > 0
    until(lambda: served.logged("refused a robot at 127.0.0.1"))
    keys.let_in("stranger")
    assert offload.wait_for_sites(echo, WAIT_S) == {}


def test_a_stolen_public_key_is_of_no_use(keys: Keys, serve: Serve) -> None:
    """Public keys of robot and server without the private one: the handshake fails."""
    known = robot_keys(keys.add("arm"), "cloud")
    served = serve(keys)
    _, own_secret = zmq.curve_keypair()
    with Dealer(served.port, known.own.public, own_secret, known.server) as thief:
        assert thief.handshake == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    with Dealer(served.port, known.own.public, known.own.secret, known.server) as owner:
        assert owner.handshake == zmq.EVENT_HANDSHAKE_SUCCEEDED


def test_a_removed_robot_is_cut_off(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Revoked key: its live connection ends within 5 s, its tasks stay onboard, others are not touched."""
    served = serve(keys)
    removed, other = (robot(served.endpoint, keys.add(name)) for name in ("removed", "other"))
    for offload in (removed, other):
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        assert offload(echo, 1) == 1
    keys.remove("removed")
    took_s = until(lambda: why_not(removed), within_s=CUT_S)
    print(f"cut off after {took_s:.2f} s")
    stays_onboard(removed)
    until(lambda: REFUSED in why_not(removed))
    assert served.logged("cut off robot removed") == 1
    assert other(echo, 2) == 2
    assert other.last is not None
    assert other.last.used == "cloud"
    assert other.last.executions[0].ok


def test_a_removed_robot_gets_no_answer(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """Revoked key: what it waited for does not run, what runs is not answered, its connection is closed."""
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
        with pipe.open() as reader:  # the first task may end now
            assert reader.read()
        until(lambda: httpx.get(f"{served.http}/health").json()["running"] == 0)
        assert not raw.socket.poll(0)
    assert not mark.exists()
    assert metric(served, 'requests_total{kind="mark_once",status="cancelled"}') == 1
    assert metric(served, 'dropped_total{reason="unknown robot"}') == 1


def test_a_broken_file_does_not_keep_a_removed_robot_in(keys: Keys, serve: Serve, robot: Robot) -> None:
    """While a file of the folder cannot be read the others come and go; it is named in the log."""
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
    """A folder that cannot be read is as an empty one: robots are cut off, and come back with it."""
    served = serve(keys)
    offload = robot(served.endpoint, keys.add("arm"))
    assert offload.wait_for_sites(echo, WAIT_S) == {}
    aside = keys.robots.rename(keys.robots.with_name("aside"))
    until(lambda: why_not(offload), within_s=CUT_S)
    stays_onboard(offload)
    aside.rename(keys.robots)
    assert offload.wait_for_sites(echo, WAIT_S) == {}


def test_a_key_is_changed_without_a_lost_task(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Rotation: new key added, old one removed while both ask; no task is lost, the new one's run there."""
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
    print(f"{len(before.result())} tasks with the old key, {len(after.result())} with the new one")


def test_a_replayed_request_does_not_run(keys: Keys, serve: Serve, robot: Robot, tmp_path: Path) -> None:
    """What a robot said, said again on a new connection or on its own: refused, and the task ran once."""
    folder, mark = keys.add("arm"), tmp_path / "mark"
    served = serve(keys)
    with recorded(served.port) as way:
        offload = robot(f"tcp://127.0.0.1:{way.port}", folder)
        assert offload.wait_for_sites(mark_once, WAIT_S) == {}
        before = len(way.said)
        assert offload(mark_once, str(mark)) == served.process.pid
        request = way.said[before:]
        assert request
        answer = says_until_closed(served.port, way.said)  # returns: the server has closed the connection
        assert b"READY" not in answer
        way.server.sendall(request)
        until(lambda: why_not(offload))
    assert mark.read_text().count("\n") == 1


def test_a_server_with_another_key_gets_no_task(keys: Keys, serve: Serve, robot: Robot) -> None:
    """Wrong server key at the robot: whoever poses as its server hears nothing that it can read."""
    folder = keys.add("arm")
    served = serve(keys)
    (folder / "server.key").unlink()
    make_keys(folder, "server")
    (folder / f"server{PRIVATE}").unlink()
    offload = robot(served.endpoint, folder)
    until(lambda: UNFIT in why_not(offload))
    stays_onboard(offload)
    assert metric(served, "bytes_in_total") == 0


def test_a_plain_server_gets_no_task_from_a_robot_with_keys(keys: Keys, serve: Serve, robot: Robot) -> None:
    """A robot with keys does not fall back to plain text."""
    served = serve(None)
    offload = robot(served.endpoint, keys.add("arm"))
    until(lambda: UNFIT in why_not(offload))
    assert metric(served, "bytes_in_total") == 0


@pytest.mark.parametrize(
    "said",
    [
        b"GET / HTTP/1.1\r\nHost: here\r\n\r\n" + b" " * 64,
        # A greeting of ZMTP 3.0 with the mechanism NULL, READY, and a message.
        b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48) + b"\x04\x06\x05READY" + b"\x00\x05hello",
    ],
    ids=["http", "null"],
)
def test_plain_text_is_not_read(keys: Keys, serve: Serve, said: bytes) -> None:
    """Plain-text client on a CURVE port: the connection is closed, and no message reaches the server."""
    served = serve(keys)
    answered = says_until_closed(served.port, said)
    assert b"READY" not in answered
    assert metric(served, "bytes_in_total") == 0


def test_each_site_has_its_own_server_key(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """NAME.key pins the server of --site NAME, server.key all others; the robot's own key is the same."""
    (tmp_path / "elsewhere").mkdir()
    others = Keys(tmp_path / "elsewhere")
    folder = keys.add("arm")
    (folder / "edge.key").write_bytes((others.server / "server.key").read_bytes())
    (others.robots / "arm.key").write_bytes((folder / "robot.key").read_bytes())
    cloud, edge = serve(keys), serve(others)
    with Offloader.connect(cloud.endpoint, sites={"edge": edge.endpoint}, keys=str(folder)) as offload:
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        for site in ("cloud", "edge"):
            assert offload(nap, 0.0, where=site) == 0.0
            assert offload.last is not None
            assert offload.last.used == site


def test_the_robot_command_takes_keys(keys: Keys, serve: Serve, tmp_path: Path) -> None:
    """`robot-client --keys` runs its tasks in the cloud; the environment says the same."""
    served = serve(keys)
    folder, answers = keys.add("arm"), tmp_path / "trace.jsonl"
    flags = ["--task", "tests.probes:nap", "--sizes", "constant:0", "--policy", "cloud", "--tasks", "3"]
    flags += ["--cloud", served.endpoint, "--trace", str(answers)]
    done = run("robot_client", *flags, ROBOT_KEYS=str(folder))
    assert done.returncode == 0, done.stderr
    assert answers.read_text().count('"used":"cloud"') == 3, answers.read_text()


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o660])
def test_a_private_key_that_others_may_use_is_refused(keys: Keys, tmp_path: Path, mode: int) -> None:
    """Private key readable by others: server and robot say so in one line and end with 2."""
    robot = keys.add("arm")
    for folder, name in ((keys.server, "server"), (robot, "robot")):
        (folder / f"{name}{PRIVATE}").chmod(mode)
    token = token_file(tmp_path)
    token.chmod(mode)
    nap_flags = ["--task", "tests.probes:nap", "--sizes", "constant:0", "--cloud", "tcp://127.0.0.1:1"]
    for package, flags, flag, path in (
        ("cloud_server", ["--keys", keys.server], "--keys", keys.server / f"server{PRIVATE}"),
        ("cloud_server", ["--token-file", token], "--token-file", token),
        ("robot_client", [*nap_flags, "--keys", robot], "--keys", robot / f"robot{PRIVATE}"),
    ):
        done = run(package, *map(str, flags))
        assert done.returncode == 2
        prog = package.replace("_", "-")
        assert done.stderr == (
            f"{prog}: {flag}: {path} has mode {mode:04o}, so other users may access it: chmod 600 {path}\n"
        )


CLOUD, WAN = ["cloud_server"], ["loadgen", "wan"]
OPEN, TO_ALL = "is beyond loopback and without", "0.0.0.0:0"


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ([*CLOUD, "--listen", f"tcp://{TO_ALL}"], f"--listen: tcp://{TO_ALL} {OPEN} --keys"),
        ([*CLOUD, "--listen", "tcp://*:0"], f"--listen: tcp://*:0 {OPEN} --keys"),
        ([*CLOUD, "--http", TO_ALL], f"--http: {TO_ALL} {OPEN} --token-file"),
        ([*CLOUD, "--http", "[::]:0"], f"--http: [::]:0 {OPEN} --token-file"),
        ([*CLOUD, "--robots", "."], "--robots: . needs --keys, the server's own"),
        ([*CLOUD, "--keys", "none"], "--keys: none/server.key_secret: No such file or directory"),
        ([*WAN, "--http", TO_ALL], f"--http: {TO_ALL} {OPEN} --token-file"),
        ([*WAN, "--token-file", "none"], "--token-file: none: No such file or directory"),
    ],
)
def test_what_would_be_open_to_all_is_refused(command: list[str], error: str) -> None:
    """Beyond loopback without keys or token: one line that names flag and remedy, exit code 2."""
    done = run(*command)
    assert done.returncode == 2, done.stderr
    assert f": {error}" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_wrong_folder_of_robots_is_refused(keys: Keys) -> None:
    """At start a file that is no public key, and a folder that is not there, are one line and exit code 2."""
    torn = keys.robots / "torn.key"
    torn.write_text("curve\n")
    done = run("cloud_server", "--keys", str(keys.server), "--log", "error")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith(f"cloud-server: --robots: {torn}: no public-key under `curve`")
    torn.unlink()
    keys.robots.rmdir()
    done = run("cloud_server", "--keys", str(keys.server), "--log", "error")
    assert done.returncode == 2
    assert done.stderr == (
        f"cloud-server: --robots: {keys.robots}: No such file or directory; "
        "it must hold the public key of each robot\n"
    )


def test_insecure_is_said(serve: Serve, robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    """--insecure lets anybody in, warns, and shows in /health; the robot says once that it has no keys."""
    served = serve(None, "--listen", "tcp://0.0.0.0:0", "--http", "0.0.0.0:0", "--insecure")
    until(
        lambda: served.logged("--insecure: --listen: tcp://0.0.0.0:0 is beyond loopback and without --keys;")
    )
    assert httpx.get(f"{served.http}/health").json()["insecure"] is True
    with caplog.at_level(logging.WARNING, "offboard.robot_client.sites.cloud"):
        for _ in range(2):
            offload = robot(served.endpoint.replace("127.0.0.1", "0.0.0.0"), None)
            assert offload.wait_for_sites(echo, WAIT_S) == {}
    assert caplog.text.count("without keys") == 1


def test_http_needs_its_token(serve: Serve, tmp_path: Path) -> None:
    """Missing or wrong token beyond loopback: 401 but for health and readiness, which then say little."""
    served = serve(None, "--http", "0.0.0.0:0", "--token-file", str(token_file(tmp_path)))
    wrong = [None, "Bearer", "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}"]
    for authorization in wrong:
        headers = {"Authorization": authorization} if authorization else {}
        with httpx.Client(base_url=served.http, headers=headers) as http:
            for path in ("/metrics", "/config", "/tasks", "/docs", "/openapi.json", "/nothing"):
                refused = http.get(path)
                assert (refused.status_code, refused.headers["www-authenticate"]) == (401, "Bearer"), path
                assert VERSION not in refused.text
                assert SAFE_HEADERS.items() <= dict(refused.headers).items()
            assert http.get("/health").json() == {"healthy": True, "insecure": False}
            assert http.get("/ready").json() == {"ready": True}
    with httpx.Client(base_url=served.http, headers={"Authorization": f"Bearer {TOKEN}"}) as http:
        assert http.get("/health").json()["version"] == VERSION
        for path in ("/metrics", "/config", "/tasks", "/docs"):
            answer = http.get(path)
            assert answer.status_code == 200
            assert SAFE_HEADERS.items() <= dict(answer.headers).items()
            assert "default-src 'none'" in answer.headers["content-security-policy"]
            assert "server" not in answer.headers
        assert TOKEN not in http.get("/config").text
        for method in ("POST", "PUT", "PATCH", "DELETE"):
            for path in ("/config", "/tasks", "/health", "/metrics"):
                assert http.request(method, path).status_code == 405


def test_metrics_are_open_on_loopback(serve: Serve, tmp_path: Path) -> None:
    """With a token on loopback metrics need none; settings and tasks do."""
    served = serve(None, "--token-file", str(token_file(tmp_path)))
    assert httpx.get(f"{served.http}/metrics").status_code == 200
    assert httpx.get(f"{served.http}/config").status_code == 401


def test_web_pages_of_others_are_kept_out(serve: Serve) -> None:
    """A page in a browser on this computer reads nothing: by its origin or by a name for loopback."""
    served = serve(None)
    port = served.http.rpartition(":")[2]
    assert httpx.get(f"{served.http}/config", headers={"Origin": "http://evil.example"}).status_code == 403
    assert httpx.get(f"{served.http}/config", headers={"Host": f"evil.example:{port}"}).status_code == 403
    assert httpx.get(f"{served.http}/config", headers={"Host": f"localhost:{port}"}).status_code == 200


def test_the_relay_needs_its_token(wan: Any, tmp_path: Path) -> None:
    """Beyond loopback the relay's link is neither read nor changed without the token; health is open."""
    relay = wan(1, "--http", "0.0.0.0:0", "--token-file", str(token_file(tmp_path)))
    with httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}") as http:
        assert http.get("/health").json() == {"status": "ok", "insecure": False}
        for method, path in (("GET", "/link"), ("PUT", "/link"), ("POST", "/reset"), ("POST", "/schedule")):
            assert http.request(method, path, json={"outage": True}).status_code == 401
        http.headers["Authorization"] = f"Bearer {TOKEN}"
        assert http.get("/link").json()["outage"] is False
        changed = http.put("/link", json={"outage": True})
        assert changed.json()["outage"] is True
        assert SAFE_HEADERS.items() <= dict(changed.headers).items()


def test_an_open_relay_is_insecure(wan: Any) -> None:
    """--insecure: anybody may command it, and its health says so; a web page may not."""
    relay = wan(1, "--http", "0.0.0.0:0", "--insecure")
    url = f"http://127.0.0.1:{relay.http_port}"
    assert httpx.get(f"{url}/health").json()["insecure"] is True
    assert httpx.get(f"{url}/link").status_code == 200
    assert httpx.post(f"{url}/reset", headers={"Origin": "http://evil.example"}).status_code == 403


def test_keys_are_made_once(tmp_path: Path) -> None:
    """`keys` makes files that the commands take, and overwrites none: one line, exit code 2."""
    made = {"cloud_server": "server", "robot_client": "robot"}
    for package, name in made.items():
        flags = [package, "keys", "--out", str(tmp_path)]
        first = run(*flags)
        assert first.returncode == 0, first.stderr
        private = (tmp_path / f"{name}{PRIVATE}").read_bytes()
        again = run(*flags)
        assert again.returncode == 2
        assert again.stderr == (
            f"{package.replace('_', '-')}: --out: {tmp_path / f'{name}{PRIVATE}'} already exists and "
            "is not overwritten; choose another folder\n"
        )
        assert (tmp_path / f"{name}{PRIVATE}").read_bytes() == private
        shown = run(*flags, "--help")
        assert (shown.returncode, "--out DIR" in shown.stdout) == (0, True)
    assert server_keys(tmp_path).public == robot_keys(tmp_path, "cloud").server
    assert (tmp_path / "robots").is_dir()
