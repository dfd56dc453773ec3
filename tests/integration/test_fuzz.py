"""Fuzzing: random inputs must not break their readers. `python -m tests.fuzz` runs it for longer."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.curves import ROOT, Served, clean_environ

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

FUZZ_S = 60
TOKEN = "a-token-of-the-tests"


@pytest.mark.skipif(
    find_spec("atheris") is None, reason="atheris is not installed: it has wheels for Linux on x86_64"
)
def test_no_message_breaks_its_reader(tmp_path: Path) -> None:
    """A minute of coverage-guided fuzzing finds no crash, no hang and no unexpected exception."""
    limits = [f"-max_total_time={FUZZ_S}", "-timeout=10", "-rss_limit_mb=2048", "-max_len=8192", "-seed=1"]
    command = [sys.executable, "-m", "tests.fuzz", str(tmp_path / "corpus"), *limits]
    done = subprocess.run(
        [*command, f"-artifact_prefix={tmp_path}/"],
        cwd=ROOT,
        env=clean_environ(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    runs = re.search(r"Done (\d+) runs", done.stderr)
    assert runs is not None, done.stderr[-2000:]
    assert int(runs[1]) > 10_000
    print(done.stderr.splitlines()[-1])


@pytest.mark.parametrize("guarded", [False, True], ids=["open", "token"])
def test_http_matches_its_openapi(tmp_path: Path, guarded: bool) -> None:
    """Good and bad requests, made from the OpenAPI of the server, are answered as it says, never with 5xx."""
    token = tmp_path / "token"
    token.touch(0o600)
    token.write_text(TOKEN)
    served = Served(*(["--token-file", str(token)] if guarded else []))
    try:
        flags = ["--checks", "all", "--max-examples", "30", "--seed", "1", "--workers", "1", "--no-color"]
        if guarded:
            flags += ["--header", f"Authorization: Bearer {TOKEN}"]
        done = subprocess.run(
            [sys.executable, "-m", "schemathesis.cli", "run", f"{served.http}/openapi.json", *flags],
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
        assert served.process.poll() is None
    finally:
        served.close()
