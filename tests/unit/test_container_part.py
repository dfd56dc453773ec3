"""What the Docker testbed works out without an engine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.testbed.container_output import Output
from offboard.loadgen.testbed.container_part import as_popen, as_seen, measured, quota
from offboard.loadgen.testbed.process_owner import is_gone, owner


def test_files_are_seen_where_they_are_mounted(tmp_path: Path) -> None:
    """A path under the run's folder is under /out, another one beside its neighbours; the rest stays."""
    out, maps = tmp_path / "out", tmp_path / "maps"
    (out / "deep").mkdir(parents=True)
    maps.mkdir()
    flags = {"map": maps / "a.yaml", "samples": maps / "b", "trace": out / "deep" / "t.jsonl", "tasks": 5}
    seen, folders = as_seen("robot", flags, out)
    assert {name: str(value) for name, value in seen.items()} == {
        "map": "/in/0/a.yaml",
        "samples": "/in/0/b",
        "trace": "/out/deep/t.jsonl",
        "tasks": "5",
    }
    assert folders == {maps: Path("/in/0"), out: Path("/out")}


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    """Docker would make it; here it is wrong usage, named by part and flag."""
    with pytest.raises(ConfigError, match=r"^robot: --up-samples: .*/no/file: its folder does not exist$"):
        as_seen("robot", {"up_samples": tmp_path / "no" / "file"}, tmp_path / "out")


@pytest.mark.parametrize(
    ("code", "popen"), [(0, 0), (2, 2), (130, 130), (137, -9), (139, -11), (141, 141), (143, -15), (255, 255)]
)
def test_an_exit_code_is_as_popen_has_it(code: int, popen: int) -> None:
    """Minus the signal; 130 and 141 are what our commands say themselves."""
    assert as_popen(code) == popen


def test_quotas_are_over_10_ms() -> None:
    """Longer only where the kernel would refuse the quota: it takes no less than 1 ms."""
    assert quota(0.5) == {"cpu_period": 10_000, "cpu_quota": 5_000}
    assert quota(0.05) == {"cpu_period": 20_000, "cpu_quota": 1_000}


def test_pages_are_bytes() -> None:
    """Memory is counted in the machine's pages."""
    usage = measured(b"10 7\n")
    assert (usage.memory_bytes, usage.handles) == (10 * os.sysconf("SC_PAGE_SIZE"), 7)


def test_a_process_that_has_ended_is_gone() -> None:
    """We are not, a child that has ended is, and of another host's nothing is known."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        name = owner(child.pid)
        assert not is_gone(name)
    assert is_gone(name)
    assert not is_gone(owner(os.getpid()))
    assert not is_gone(f"elsewhere/{name}")


def test_output_is_kept_whole_and_its_end_is_told(tmp_path: Path) -> None:
    """A log begins anew, goes on where it was when a part starts again, and ends with the last lines."""
    log = tmp_path / "logs" / "cloud.log"
    for again, chunks in ((False, [b"one\nt", b"wo\n"]), (True, [b"three\n"])):
        output = Output("cloud", iter(chunks), log, again=again)
        output.start()
        output.finish()
    assert log.read_text() == "one\ntwo\nthree\n"
    assert output.tail() == "three"


def test_shown_output_is_ours(capsys: pytest.CaptureFixture[str]) -> None:
    """Also letters that come in two pieces."""
    output = Output("robot", iter([b"caf\xc3", b"\xa9\n"]), None)
    output.start()
    output.finish()
    assert capsys.readouterr().out == "caf\u00e9\n"
