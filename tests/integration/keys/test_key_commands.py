"""What the commands say about keys and tokens at start (docs/security.md), with real processes."""

import logging
from pathlib import Path

import httpx
import pytest

from benchmarks.keyring import Keys
from offboard.common.security.keys import PRIVATE, robot_keys, server_keys
from tests.curves import WAIT_S, until
from tests.integration.keys.servers import Robot, Serve, run, token_file
from tests.probes import echo

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]


def test_keys_are_made_once(tmp_path: Path) -> None:
    """`keys` makes files that the commands accept. It never overwrites one: one line and exit code 2."""
    made = {"cloud_server": "server", "robot_client": "robot"}
    for package, name in made.items():
        flags = [package, "keys", "--out", str(tmp_path)]
        first = run(*flags)
        assert first.returncode == 0, first.stderr
        private = (tmp_path / f"{name}{PRIVATE}").read_bytes()
        again = run(*flags)
        assert again.returncode == 2
        assert again.stderr == (
            f"{package.replace('_', '-')} keys: --out: {tmp_path / f'{name}{PRIVATE}'} already exists and "
            "is not overwritten; choose another folder\n"
        )
        assert (tmp_path / f"{name}{PRIVATE}").read_bytes() == private
        shown = run(*flags, "--help")
        assert (shown.returncode, "--out DIR" in shown.stdout) == (0, True)
    assert server_keys(tmp_path).public == robot_keys(tmp_path, "cloud").server
    assert (tmp_path / "robots").is_dir()


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o660])
def test_a_private_key_that_others_may_use_is_refused(keys: Keys, tmp_path: Path, mode: int) -> None:
    """If others may read a private key or token, server and robot say so in one line and end with 2."""
    robot = keys.add("arm")
    for folder, name in ((keys.server, "server"), (robot, "robot")):
        (folder / f"{name}{PRIVATE}").chmod(mode)
    token = token_file(tmp_path)
    token.chmod(mode)
    nap_flags = [
        "call",
        "--task",
        "tests.probes:nap",
        "--sizes",
        "constant:0",
        "--cloud",
        "tcp://127.0.0.1:1",
    ]
    for package, flags, flag, path in (
        ("cloud_server", ["--keys", keys.server], "--keys", keys.server / f"server{PRIVATE}"),
        ("cloud_server", ["--token-file", token], "--token-file", token),
        ("loadgen", [*nap_flags, "--keys", robot], "--keys", robot / f"robot{PRIVATE}"),
    ):
        done = run(package, *map(str, flags))
        assert done.returncode == 2
        prog = package.replace("_", "-") + (" call" if package == "loadgen" else "")
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
        ([*CLOUD, "--robots", "."], "--robots: . needs --keys, the keys of the server"),
        ([*CLOUD, "--keys", "none"], "--keys: none/server.key_secret: No such file or directory"),
        ([*WAN, "--http", TO_ALL], f"--http: {TO_ALL} {OPEN} --token-file"),
        ([*WAN, "--token-file", "none"], "--token-file: none: No such file or directory"),
    ],
)
def test_what_would_be_open_to_all_is_refused(command: list[str], error: str) -> None:
    """An address beyond loopback without keys or token is refused in one line, with flag and remedy."""
    done = run(*command)
    assert done.returncode == 2, done.stderr
    assert f": {error}" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_wrong_folder_of_robots_is_refused(keys: Keys) -> None:
    """A file that is no public key, or a missing folder, gives one line and exit code 2 at start."""
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
    """The server with --insecure warns and says so in /health. The robot warns once that it has no keys."""
    served = serve(None, "--listen", "tcp://0.0.0.0:0", "--http", "0.0.0.0:0", "--insecure")
    until(
        lambda: served.logged("--insecure: --listen: tcp://0.0.0.0:0 is beyond loopback and without --keys;")
    )
    assert httpx.get(f"{served.http}/health").json()["insecure"] is True
    with caplog.at_level(logging.WARNING, "offboard.robot_client.cloud.cloud_socket"):
        for _ in range(2):
            offload = robot(served.endpoint.replace("127.0.0.1", "0.0.0.0"), None)
            assert offload.wait_for_sites(echo, WAIT_S) == {}
    assert caplog.text.count("without keys") == 1
