"""Reading private files and the HTTP token."""

from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import read_private, read_token

TOKEN = "a-token-of-the-tests"


@pytest.mark.parametrize(
    ("text", "mode", "error"),
    [
        ("short", 0o600, "must hold one token of at least 16 characters"),
        ("two tokens are not one", 0o600, "must hold one token"),
        ("", 0o600, "must hold one token"),
        (TOKEN, 0o644, "has mode 0644, so other users may access it: chmod 600"),
        ("x" * 70_000, 0o600, "is larger than 65536 bytes"),
    ],
)
def test_a_wrong_token_file_is_named(tmp_path: Path, text: str, mode: int, error: str) -> None:
    """The error names flag and file, and does not show the token."""
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=f"^--token-file: {path} {error}") as caught:
        read_token(path)
    assert TOKEN not in str(caught.value)


def test_the_newline_at_the_end_is_not_part_of_the_token(tmp_path: Path) -> None:
    """Editors add one. Without a file there is no token."""
    path = tmp_path / "token"
    path.touch(0o600)
    path.write_text(f"{TOKEN}\n")
    assert read_token(path) == TOKEN
    assert read_token(None) is None


def test_an_unreadable_private_file_is_named(tmp_path: Path) -> None:
    """Bytes that are not text, a folder and a missing file are each a ConfigError with the reason."""
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_bytes(b"\xff")
    for name, error in (
        (path, "is not a text file"),
        (tmp_path, "Is a directory"),
        (tmp_path / "no", "No such"),
    ):
        with pytest.raises(ConfigError, match=error):
            read_private("--keys", name)
