"""The list of servers in a file: what is taken, what is refused, and when a change counts."""

import logging
import os
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Roster, Server
from offboard.robot_client.discovery.server_lists import GROUPS_MAX, TEND_S, Following, SitesFile
from offboard.robot_client.sites.runner import ONBOARD
from tests.virtual import VirtualClock, VirtualRunner

GPU = '[gpu]\nendpoint = "tcp://10.0.0.7:5555"\n'
EQUAL = '[a]\nendpoint = "tcp://10.0.0.8:5555"\ngroup = "planners"\n'


def key_of(site: str, given: str | None) -> bytes | None:
    if site == "nokey":
        raise ConfigError("it needs keys")
    return None if given is None else given.encode()


@pytest.fixture
def listed(tmp_path: Path) -> SitesFile:
    (tmp_path / "sites.toml").write_text(GPU)
    return SitesFile(tmp_path / "sites.toml", key_of, {ONBOARD})


def test_a_file_lists_servers_by_name(listed: SitesFile, tmp_path: Path) -> None:
    """A server of a group has the name GROUP/NAME, and each may have its own key."""
    (tmp_path / "sites.toml").write_text(f'{GPU}key = "k"\n{EQUAL}')
    assert listed.read() == [
        Server("gpu", "tcp://10.0.0.7:5555", b"k"),
        Server("planners/a", "tcp://10.0.0.8:5555"),
    ]


def test_a_policy_server_may_have_a_token(listed: SitesFile, tmp_path: Path) -> None:
    """It is in a private file next to the list, and is not shown; the server needs no key."""
    (tmp_path / "gpu.token").write_text("a-secret\n")
    (tmp_path / "gpu.token").chmod(0o600)
    (tmp_path / "sites.toml").write_text(
        '[gpu]\nendpoint = "wss://10.0.0.7:8000"\ntoken_file = "gpu.token"\n'
        '[near]\nendpoint = "groot://127.0.0.1:5555"\n'
    )
    servers = listed.read()
    assert servers == [
        Server("gpu", "wss://10.0.0.7:8000", token="a-secret"),
        Server("near", "groot://127.0.0.1:5555"),
    ]
    assert "a-secret" not in repr(servers)


def test_a_token_that_others_can_read_is_refused(listed: SitesFile, tmp_path: Path) -> None:
    """The error names the file, and not the token."""
    (tmp_path / "gpu.token").write_text("a-secret\n")
    (tmp_path / "gpu.token").chmod(0o644)
    (tmp_path / "sites.toml").write_text(
        '[gpu]\nendpoint = "wss://10.0.0.7:8000"\ntoken_file = "gpu.token"\n'
    )
    with pytest.raises(DataError, match=r"\[gpu\]: token_file: .*gpu\.token") as raised:
        listed.read()
    assert "a-secret" not in str(raised.value)


def test_a_change_counts_once_two_reads_agree(listed: SitesFile, tmp_path: Path) -> None:
    """A list that is being written, even one that is whole so far, is not used before it stands still."""
    path = tmp_path / "sites.toml"
    assert listed.read() == [Server("gpu", "tcp://10.0.0.7:5555")]
    assert listed.read() is None
    path.write_text(EQUAL)
    assert listed.read() is None
    assert listed.settling
    path.write_text(EQUAL + GPU)
    assert listed.read() is None
    assert [one.site for one in listed.read() or []] == ["planners/a", "gpu"]
    assert not listed.settling
    assert listed.read() is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "0 servers; allowed are 1 to 1000"),
        (f"a = {'[' * 5_000}", "sites.toml: (maximum recursion depth|.* nested)"),
        (f"a = {'1' * 5_000}", "sites.toml: Exceeds the limit"),
        ("[gpu", "Expected .* at the end of a table declaration"),
        ("gpu = 1", r"\[gpu\]: must be a table with `endpoint`"),
        ("[gpu]", r"\[gpu\]: `endpoint` is missing"),
        ("[gpu]\nendpoint = 5", r"\[gpu\]: endpoint 5 must be a string"),
        ('[gpu]\nendpoint = "tcp://a"', r"\[gpu\]: endpoint: 'tcp://a' is not tcp://HOST:PORT"),
        (f'{GPU}keys = "a"', r"\[gpu\]: unknown key 'keys'; did you mean 'key'\?"),
        (f'{GPU}token_file = "a"', r"\[gpu\]: token_file: only policy servers"),
        (GPU.replace("tcp", "wss") + 'key = "a"', r"\[gpu\]: key: a policy server has none"),
        (GPU.replace("tcp", "ws"), r"\[gpu\]: endpoint: 'ws://10.0.0.7:5555' is not encrypted"),
        (f'{GPU}group = "a b"', r"\[gpu\]: 'a b' is not a free name"),
        (GPU.replace("gpu", "onboard"), r"\[onboard\]: 'onboard' is not a free name"),
        (GPU.replace("gpu", "nokey"), r"\[nokey\]: it needs keys"),
        ("\ufffe".join(GPU), "sites.toml: "),
        (
            "".join(GPU.replace("gpu", f"gpu{n}") for n in range(GROUPS_MAX + 1)),
            "33 groups and servers without a group; at most 32",
        ),
        (GPU + "#" * 1_000_000, "over 1000000 bytes"),
    ],
)
def test_a_mistake_is_named(listed: SitesFile, tmp_path: Path, text: str, said: str) -> None:
    """Each mistake is one line with the file, the server, the value and what is allowed."""
    (tmp_path / "sites.toml").write_text(text)
    with pytest.raises(DataError, match=said) as raised:
        listed.read()
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path / "sites.toml"))


@pytest.mark.parametrize("linked", [False, True])
def test_what_is_no_plain_file_is_refused_at_once(
    listed: SitesFile, tmp_path: Path, linked: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A FIFO, which may never be written, is no list; the servers stay, and one line says so."""
    path, clock = tmp_path / "sites.toml", VirtualClock()
    sites = PresentSites(
        [VirtualRunner(ONBOARD, clock)],
        roster=Roster(),
        connect=lambda server: VirtualRunner(server.site, clock),
    )
    following = Following(listed, sites, 1.0)
    following.read()
    path.unlink()
    fifo = tmp_path / "fifo" if linked else path
    os.mkfifo(fifo)
    if linked:
        path.symlink_to(fifo)
    with pytest.raises(DataError, match=r"sites\.toml: is a FIFO, not a plain file$"):
        listed.read()
    for _ in range(3):
        following.read()
    assert caplog.text.count("is a FIFO, not a plain file") == 1
    assert set(sites) == {ONBOARD, "gpu"}
    path.unlink()
    path.mkdir()
    with pytest.raises(DataError, match="is a folder, not a plain file"):
        listed.read()


def test_a_link_to_a_plain_file_is_followed(listed: SitesFile, tmp_path: Path) -> None:
    """Kubernetes mounts files as links."""
    (tmp_path / "sites.toml").rename(tmp_path / "other.toml")
    (tmp_path / "sites.toml").symlink_to(tmp_path / "other.toml")
    assert [one.site for one in listed.read() or []] == ["gpu"]


def test_an_equal_problem_is_logged_again_once_the_list_was_right(
    listed: SitesFile, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also if the right list is the one that is in use, as after a writer that was interrupted."""
    clock, path = VirtualClock(), tmp_path / "sites.toml"
    sites = PresentSites(
        [VirtualRunner(ONBOARD, clock)],
        roster=Roster(),
        connect=lambda server: VirtualRunner(server.site, clock),
    )
    following = Following(listed, sites, 1.0)
    for time in range(1, 4):
        for text in (GPU, "[gpu"):
            path.write_text(text)
            for _ in range(3):
                following.read()
        assert len(caplog.records) == time
    for time in range(4, 6):
        path.unlink()
        for _ in range(3):
            following.read()
        path.write_text(GPU)
        for _ in range(3):
            following.read()
        assert len(caplog.records) == time


def test_a_surprise_does_not_end_the_thread(listed: SitesFile, caplog: pytest.LogCaptureFixture) -> None:
    """An error that nobody expects is logged once with its traceback, and the list is read again."""
    clock, fails = VirtualClock(), [True]

    def connect(server: Server) -> VirtualRunner:
        if fails:
            raise RuntimeError("surprise")
        return VirtualRunner(server.site, clock)

    sites = PresentSites([VirtualRunner(ONBOARD, clock)], roster=Roster(), connect=connect)
    following = Following(listed, sites, TEND_S)
    for _ in range(5):
        following.tend(TEND_S)
    assert caplog.text.count("RuntimeError: surprise") == 1
    assert "remedy: " in caplog.text
    fails.clear()
    following.tend(TEND_S)
    assert set(sites) == {ONBOARD, "gpu"}


def test_servers_are_tended_between_two_reads(listed: SitesFile, tmp_path: Path) -> None:
    """One that lacked files is tried again soon, though the file is not read yet."""
    clock, full = VirtualClock(), [True]

    def connect(server: Server) -> VirtualRunner:
        if full:
            raise OffloadError("no file is left")
        return VirtualRunner(server.site, clock)

    sites = PresentSites([VirtualRunner(ONBOARD, clock)], roster=Roster(), connect=connect)
    following = Following(listed, sites, 100 * TEND_S)
    following.read()
    full.clear()
    (tmp_path / "sites.toml").write_text(EQUAL)
    following.tend(TEND_S)
    assert set(sites) == {ONBOARD, "gpu"}
    assert not listed.settling


def test_a_problem_is_logged_once_and_the_servers_stay(
    listed: SitesFile, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A broken or missing file changes nothing; a corrected one is used, and the next problem is logged."""
    clock, path = VirtualClock(), tmp_path / "sites.toml"
    sites = PresentSites(
        [VirtualRunner(ONBOARD, clock)],
        roster=Roster(),
        connect=lambda server: VirtualRunner(server.site, clock),
    )
    following = Following(listed, sites, 1.0)
    following.read()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            caplog.clear()
            path.write_text("[gpu")
            for _ in range(5):
                following.read()
            path.unlink()
            for _ in range(5):
                following.read()
            assert set(sites) == {ONBOARD, "gpu"}
            assert len(caplog.records) == 2
            assert "no such file" in caplog.records[1].getMessage().lower()
            path.write_text(EQUAL)
            for _ in range(3):
                following.read()
            assert set(sites) == {ONBOARD, "planners/a"}
            path.write_text(GPU)
            for _ in range(3):
                following.read()
