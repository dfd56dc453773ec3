"""The pure functions of the Docker testbed, which need no engine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from offboard.common.errors import ConfigError
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.testbed.container_part import IMAGES, as_popen, as_seen, measured, quota, service_of
from offboard.loadgen.testbed.docker_engine import is_gone, owner
from offboard.loadgen.testbed.real_testbed import Output


def test_flags_name_files_where_they_are_mounted(tmp_path: Path) -> None:
    """A file of the run is under /out, another file under /in with its folder; other flags stay the same."""
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


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    """Docker would create the folder; we report it as an error that names part and flag."""
    with pytest.raises(ConfigError, match=r"^robot: --up-samples: .*/no/file: its folder does not exist$"):
        as_seen("robot", {"up_samples": tmp_path / "no" / "file"}, tmp_path / "out")


@pytest.mark.parametrize(
    ("scenario", "services"),
    [
        ("calm", {"cloud": "cloud", "wan": "wan", "robot": "robot"}),
        ("nonlinear", {"cloud": "cloud", "wan": "wan", "robot": "robot"}),
        ("arm-busy", {"cloud": "examples", "wan": "wan", "robot": "examples"}),
    ],
)
def test_an_application_has_its_own_image(tmp_path: Path, scenario: str, services: dict[str, str]) -> None:
    """Robot and cloud use the image of the applications only if the task is in `examples/`."""
    parts = setups(read_scenario(find_scenario(scenario)), tmp_path)
    assert {part: service_of(part, setup) for part, setup in parts.items()} == services


def test_compose_builds_every_image() -> None:
    """Each image has the name that its service has in docker-compose.yml."""
    described = yaml.safe_load((Path(__file__).parents[2] / "docker-compose.yml").read_text())["services"]
    assert {service: described[service]["image"] for service in IMAGES} == dict(IMAGES)


@pytest.mark.parametrize(
    ("code", "popen"), [(0, 0), (2, 2), (130, 130), (137, -9), (139, -11), (141, 141), (143, -15), (255, 255)]
)
def test_exit_codes_are_those_of_popen(code: int, popen: int) -> None:
    """A signal becomes its negative number; 130 and 141 stay, because our commands exit with them."""
    assert as_popen(code) == popen


def test_quotas_have_a_period_of_10_ms() -> None:
    """The period is longer only if the quota would be below 1 ms, which the kernel refuses."""
    assert quota(0.5) == {"cpu_period": 10_000, "cpu_quota": 5_000}
    assert quota(0.05) == {"cpu_period": 20_000, "cpu_quota": 1_000}


def test_memory_pages_become_bytes() -> None:
    """The shell counts memory in pages of the machine."""
    usage = measured(b"10 7\n")
    assert (usage.memory_bytes, usage.handles) == (10 * os.sysconf("SC_PAGE_SIZE"), 7)


def test_only_a_process_that_has_ended_is_gone() -> None:
    """A child that has ended is gone; this process is not, and of another host's process nothing is known."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        name = owner(child.pid)
        assert not is_gone(name)
    assert is_gone(name)
    assert not is_gone(owner(os.getpid()))
    assert not is_gone(f"elsewhere/{name}")


def test_output_is_logged_completely(tmp_path: Path) -> None:
    """A log is replaced at the first start of a part, and continued at the next; `tail` gives its end."""
    log = tmp_path / "logs" / "cloud.log"
    for again, chunks in ((False, [b"one\nt", b"wo\n"]), (True, [b"three\n"])):
        output = Output("cloud", iter(chunks), log, again=again)
        output.start()
        output.finish()
    assert log.read_text() == "one\ntwo\nthree\n"
    assert output.tail() == "three"


def test_shown_output_goes_to_our_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    """Characters that are split over two chunks are shown correctly."""
    output = Output("robot", iter([b"caf\xc3", b"\xa9\n"]), None)
    output.start()
    output.finish()
    assert capsys.readouterr().out == "caf\u00e9\n"
