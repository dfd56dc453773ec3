"""Key files: making and reading them, and the errors about wrong ones."""

import stat
from pathlib import Path

import pytest
import zmq
import zmq.auth

from offboard.common.errors import ConfigError
from offboard.common.security import keys
from offboard.common.security.keys import make_keys, read_public, robot_keys, server_keys

GOOD = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID"  # this and the next one are from RFC 26
SECRET = "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs"


def secret_file(folder: Path, name: str, public: str = GOOD, secret: str = SECRET) -> Path:
    path = folder / f"{name}.key_secret"
    path.write_text(f'curve\n    public-key = "{public}"\n    secret-key = "{secret}"\n')
    path.chmod(0o600)
    return path


def test_only_the_owner_may_read_the_private_file(tmp_path: Path) -> None:
    """Its mode is 0600 whatever the umask is; everyone may read the public file."""
    public, private = make_keys(tmp_path / "deep" / "keys", "robot")
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert stat.S_IMODE(public.stat().st_mode) & 0o444
    assert (public.name, private.name) == ("robot.key", "robot.key_secret")


def test_pyzmq_reads_our_files(tmp_path: Path) -> None:
    """zmq.auth finds both keys in our private file, and only the public key in our public file."""
    public, private = make_keys(tmp_path, "server")
    both = zmq.auth.load_certificate(private)
    assert both == (server_keys(tmp_path).public, server_keys(tmp_path).secret)
    assert zmq.auth.load_certificate(public) == (both[0], None)


def test_we_read_the_files_of_pyzmq(tmp_path: Path) -> None:
    """Files made by zmq.auth work, metadata included, once the private file has mode 0600."""
    zmq.auth.create_certificates(tmp_path, "server", metadata={"public-key": "of whom"})
    private = tmp_path / "server.key_secret"
    private.chmod(0o600)
    pair = server_keys(tmp_path)
    assert (pair.public, pair.secret) == zmq.auth.load_certificate(private)
    assert read_public(tmp_path / "server.key") == pair.public


def test_existing_keys_are_never_overwritten(tmp_path: Path) -> None:
    """If the private or the public file exists, no file is written."""
    _, private = make_keys(tmp_path, "robot")
    before = private.read_text()
    with pytest.raises(ConfigError, match=r"^--out: .*robot\.key_secret already exists"):
        make_keys(tmp_path, "robot")
    assert private.read_text() == before
    private.unlink()
    with pytest.raises(ConfigError, match=r"^--out: .*robot\.key already exists"):
        make_keys(tmp_path, "robot")
    assert not private.exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    """The error is one line with the path of the folder."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"^--out: .*file/keys: Not a directory$"):
        make_keys(tmp_path / "file" / "keys", "robot")


def test_a_secret_is_not_shown(tmp_path: Path) -> None:
    """Neither the repr of a key pair nor an error about its file contains the secret key."""
    path = secret_file(tmp_path, "server")
    assert SECRET not in repr(server_keys(tmp_path))
    secret_file(tmp_path, "server", secret=SECRET[:-1])
    with pytest.raises(ConfigError) as caught:
        server_keys(tmp_path)
    assert SECRET[:8] not in str(caught.value)
    assert str(caught.value).startswith(f"{path}:3: secret-key: not a key")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", ": no public-key under `curve`"),
        (f'metadata\n    public-key = "{GOOD}"\n', ": no public-key under `curve`"),
        ("curve\n    public-key = \n", ":2: public-key: not a key; it must be 40 characters of Z85"),
        (f'curve\n    public-key = "{GOOD[1:]}"\n', ":2: public-key: not a key"),
        (f'curve\n    public-key = "{GOOD[1:]}~"\n', ":2: public-key: not a key"),
        (f'curve\n    public-key = "{"#" * 40}"\n', ":2: public-key: not a key"),
        (f'# ours\n\ncurve\n    publc-key = "{GOOD}"\n', ":4: 'publc-key': allowed are public-key, "),
        (f'curve\n    public-key = "{GOOD}"\n    public-key = "{GOOD}"\n', ":3: 'public-key': allowed are"),
        (f'curve\n  public-key = "{GOOD}"\n  secret-key = "{SECRET}"\n', ": holds a secret-key; copy "),
    ],
)  # fmt: skip
def test_a_wrong_public_file_is_named(tmp_path: Path, text: str, error: str) -> None:
    """The error names file and line, and says what must be there."""
    path = tmp_path / "arm.key"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_public(path)
    assert str(caught.value).startswith(f"{path}{error}")


def test_an_unreadable_public_file_is_named(tmp_path: Path) -> None:
    """A missing file, a folder and bytes that are not text are each a ConfigError."""
    (tmp_path / "bytes.key").write_bytes(b"\xff\xfe")
    for name, error in (("none", "No such file"), (".", "Is a directory"), ("bytes.key", "not a text file")):
        with pytest.raises(ConfigError, match=error):
            read_public(tmp_path / name)


def test_keys_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    """So is a private file without a secret key."""
    other, _ = zmq.curve_keypair()
    secret_file(tmp_path, "server", public=other.decode())
    with pytest.raises(
        ConfigError, match=r"the public-key does not belong to the secret-key; make new keys$"
    ):
        server_keys(tmp_path)
    (tmp_path / "server.key_secret").write_text(f'curve\n    public-key = "{GOOD}"\n')
    with pytest.raises(ConfigError, match=r"secret-key is missing; make new keys"):
        server_keys(tmp_path)


def test_a_site_has_its_own_server_key_or_the_common_one(tmp_path: Path) -> None:
    """The key is in SITE.key or else in server.key; a site named `robot` does not get the robot's own key."""
    make_keys(tmp_path, "robot")
    for name in ("server", "edge"):
        make_keys(tmp_path / "made", name)
        (tmp_path / f"{name}.key").write_bytes((tmp_path / "made" / f"{name}.key").read_bytes())
    common, edge = (read_public(tmp_path / f"{name}.key") for name in ("server", "edge"))
    pinned = [robot_keys(tmp_path, site).server for site in ("cloud", "edge", "robot")]
    assert pinned == [common, edge, common]


def test_the_robots_own_key_as_server_key_is_refused(tmp_path: Path) -> None:
    """Then someone has copied the wrong file."""
    make_keys(tmp_path, "robot")
    (tmp_path / "server.key").write_bytes((tmp_path / "robot.key").read_bytes())
    with pytest.raises(ConfigError, match=r"server\.key: this is the robot's own key"):
        robot_keys(tmp_path, "cloud")


def test_a_missing_server_key_is_named(tmp_path: Path) -> None:
    """A robot needs the public key of its server."""
    make_keys(tmp_path, "robot")
    with pytest.raises(
        ConfigError, match=r"server\.key: No such file or directory; it must be a public key file"
    ):
        robot_keys(tmp_path, "cloud")


def test_a_libzmq_without_curve_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is the same when keys are made and when they are read."""
    make_keys(tmp_path, "server")
    monkeypatch.setattr(keys.zmq, "has", lambda _: False)
    for call in (lambda: make_keys(tmp_path, "x"), lambda: server_keys(tmp_path)):
        with pytest.raises(ConfigError, match=r"^keys: libzmq [\d.]+ was built without CURVE; the wheel"):
            call()
