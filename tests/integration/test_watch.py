"""`loadgen watch`, and the page of a run that goes on, over real HTTP."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from offboard.common.command_line import INTERRUPTED_EXIT
from offboard.loadgen.__main__ import main
from offboard.loadgen.play.watch import Page, watching
from tests.extras import needs

pytestmark = pytest.mark.integration


def default_sigint() -> None:
    """A background process of some shells ignores Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_the_page_of_a_run_is_served_until_the_run_ends(tmp_path: Path) -> None:
    """The address is told at the start; afterwards nobody answers there."""
    said: list[str] = []
    with watching(tmp_path, said.append, page=Page.SERVED):
        (line,) = said
        match = re.fullmatch(r"live page: (http://127\.0\.0\.1:\d+/live)", line)
        assert match is not None, line
        assert httpx.get(match[1]).status_code == 200
        assert httpx.get(match[1].removesuffix("live")).status_code == 404
    with pytest.raises(httpx.ConnectError):
        httpx.get(match[1])


def test_a_run_without_plotly_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line names the extra, and the run has no page."""
    monkeypatch.setattr("offboard.common.live.live_files.find_spec", lambda _: None)
    said: list[str] = []
    with watching(tmp_path, said.append, page=Page.OPENED):
        assert said == [f"no live page: {needs('the page /live', 'live')}"]


def test_watching_ends_with_ctrl_c(tmp_path: Path) -> None:
    """It says that there is nothing to see yet, and where the page is; then it ends without a traceback."""
    command = [sys.executable, "-m", "offboard.loadgen", "watch", str(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=default_sigint) as watch:
        assert watch.stdout is not None
        assert watch.stdout.readline().startswith(f"{tmp_path} holds no trace.jsonl yet")
        address = watch.stdout.readline().removeprefix("live page: ").strip()
        assert watch.stdout.readline() == "Ctrl-C ends it\n"
        assert httpx.get(address).status_code == 200
        watch.send_signal(signal.SIGINT)
        assert watch.communicate(timeout=10)[1].splitlines() == ["loadgen watch: interrupted"]
        assert watch.returncode == INTERRUPTED_EXIT


def test_watching_what_is_no_folder_is_a_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2, and one line that names the operand, its value and what is allowed."""
    assert main(["watch", str(tmp_path / "none")]) == 2
    said = capsys.readouterr().err
    folder = tmp_path / "none"
    remedy = "give the folder of a run, such as out/run"
    assert said == f"loadgen watch: DIR: {folder} is not a folder; {remedy}\n"
