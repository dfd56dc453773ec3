"""Makes, reads and checks the key files of robots and servers, in the format of `zmq.auth.certs`."""

import argparse
import contextlib
import os
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

import zmq
from zmq.utils import z85

from offboard.common.command_line import CommandParser, add_flags
from offboard.common.config import resolve, setting
from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import PRIVATE_BYTES_MAX, read_private

PUBLIC, PRIVATE, TOKEN = ".key", ".key_secret", ".token"
SERVER, ROBOT = "server", "robot"  # names of the key files
ITEMS = ("public-key", "secret-key")

_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_TOKEN = re.compile(r"[!-~]+( [!-~]+)?")  # a scheme may come before it
_BANNERS = {
    PUBLIC: "#   ZeroMQ CURVE public certificate: may be copied, but must not be changed.",
    PRIVATE: "#   ZeroMQ CURVE **secret** certificate: do not share it, and keep its mode at 0600.",
}


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A public and a secret key, each in the 40 characters that libzmq takes."""

    public: bytes
    secret: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class RobotKeys:
    """The robot's own keys, and the public key of the one server that it trusts."""

    own: KeyPair
    server: bytes


@dataclass(frozen=True, slots=True)
class KeysConfig:
    """Settings of `cloud-server keys` and `robot-client keys`."""

    out: Path = setting(Path("keys"), "folder for the key files; created if it is missing", metavar="DIR")


def run_keys(name: str, argv: Sequence[str], *, prog: str, prefix: str, environ: Mapping[str, str]) -> Path:
    """The command `keys`: make the key files of `name` and print what they are for; returns their folder."""
    parser = CommandParser(
        prog=prog,
        description=f"Make a CurveZMQ key pair. Copy DIR/{name}{PUBLIC} to the other side; keep "
        f"DIR/{name}{PRIVATE} secret. Existing keys are never overwritten.",
    )
    add_flags(parser, KeysConfig, prefix)
    flags: argparse.Namespace = parser.parse_args(argv)
    out = resolve(KeysConfig, flags, environ=environ, prefix=prefix).out
    public, private = make_keys(out, name)
    other = ROBOT if name == SERVER else SERVER
    print(f"{private}: secret, keep it here\n{public}: public, copy it to each {other}")
    return out


def make_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a new key pair; returns the public and the private file."""
    check_curve()
    public, private = folder / f"{name}{PUBLIC}", folder / f"{name}{PRIVATE}"
    public_key, secret_key = zmq.curve_keypair()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(private, 0o600, public_key, secret_key)
        try:
            _write(public, 0o644, public_key)
        except OSError:
            private.unlink()
            raise
    except FileExistsError as error:
        raise ConfigError(
            f"--out: {error.filename} already exists and is not overwritten; choose another folder"
        ) from error
    except OSError as error:
        raise ConfigError(f"--out: {error.filename or folder}: {error.strerror}") from error
    return public, private


def server_keys(folder: Path) -> KeyPair:
    return _read_pair("--keys", folder / f"{SERVER}{PRIVATE}")


def robot_keys(folder: Path, site: str, server: bytes | None = None) -> RobotKeys:
    """The keys in the folder of a robot's --keys, for one site.

    The key of the site's server is the one that is given, or else in SITE.key, or else in server.key.
    """
    own = _read_pair("--keys", folder / f"{ROBOT}{PRIVATE}")
    if server is not None:
        return RobotKeys(own, server)
    path = folder / f"{site}{PUBLIC}"
    if site == ROBOT or not path.exists():
        path = folder / f"{SERVER}{PUBLIC}"
    server = read_public(path)
    if server == own.public:
        raise ConfigError(f"{path}: this is the robot's own key; copy the server's {SERVER}{PUBLIC} here")
    return RobotKeys(own, server)


def policy_token(folder: Path | None, site: str) -> str | None:
    """What a policy server wants to see: the text of SITE.token, a private file; None: nothing."""
    path = None if folder is None else folder / f"{site}{TOKEN}"
    return None if path is None or not path.exists() else read_token("keys", path)


def read_token(where: str, path: Path) -> str:
    """The token in a private file; ConfigError names the file."""
    token = read_private(where, path).strip()
    if not _TOKEN.fullmatch(token):
        raise ConfigError(f"{where}: {path} must hold one token: printable letters in one line")
    return token


def read_public(path: Path) -> bytes:
    """The key in a public key file; ConfigError names file and line."""
    check_curve()
    try:
        with path.open("rb") as file:
            text = file.read(PRIVATE_BYTES_MAX).decode()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; it must be a public key file (*{PUBLIC})") from error
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file; it must be a public key file (*{PUBLIC})") from None
    found = _parse(path, text)
    if "secret-key" in found:
        raise ConfigError(f"{path}: holds a secret-key; copy only the public key file (*{PUBLIC}) here")
    return found["public-key"]


def check_curve() -> None:
    """ConfigError if libzmq was built without CURVE."""
    if not zmq.has("curve"):
        raise ConfigError(
            f"keys: libzmq {zmq.zmq_version()} was built without CURVE; the wheel from PyPI has it: "
            "pip install --force-reinstall --only-binary pyzmq pyzmq"
        )


def _read_pair(where: str, path: Path) -> KeyPair:
    check_curve()
    found = _parse(path, read_private(where, path))
    if "secret-key" not in found:
        raise ConfigError(f"{path}: secret-key is missing; make new keys with the command `keys`")
    pair = KeyPair(found["public-key"], found["secret-key"])
    if zmq.curve_public(pair.secret) != pair.public:
        raise ConfigError(f"{path}: the public-key does not belong to the secret-key; make new keys")
    return pair


def _parse(path: Path, text: str) -> dict[str, bytes]:
    """The entries under `curve`: public-key and, in a private file, secret-key."""
    found: dict[str, bytes] = {}
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if line[0] not in " \t":
            section = line.strip()
        elif section == "curve":
            name, _, value = (part.strip() for part in line.partition("="))
            if name not in ITEMS or name in found:
                raise ConfigError(f"{path}:{number}: {name!r}: allowed are {', '.join(ITEMS)}, each once")
            found[name] = checked_key(f"{path}:{number}: {name}", value.strip("\"'"))
    if "public-key" not in found:
        raise ConfigError(f"{path}: no public-key under `curve`; the command `keys` makes such files")
    return found


def checked_key(where: str, text: str) -> bytes:
    """The key in this text. The error does not show the value: it may be secret."""
    with contextlib.suppress(ValueError, struct.error):
        if _KEY.fullmatch(text) and len(z85.decode(text.encode())) == 32:
            return text.encode()
    raise ConfigError(f"{where}: not a key; it must be 40 characters of Z85 in quotes")


def _write(path: Path, mode: int, public_key: bytes, secret_key: bytes | None = None) -> None:
    """Write a new file that has its mode from the start."""
    made = datetime.now(timezone.utc)
    lines = [_BANNERS[path.suffix], f"#   Made {made:%Y-%m-%d %H:%M} UTC by Offboard", ""]
    lines += ["metadata", "curve", f'    public-key = "{public_key.decode()}"']
    if secret_key is not None:
        lines.append(f'    secret-key = "{secret_key.decode()}"')
    descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
    with os.fdopen(descriptor, "w") as file:
        file.write("\n".join(lines) + "\n")
