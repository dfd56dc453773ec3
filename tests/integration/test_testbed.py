"""The local testbed keeps the testbed contract of `tests.testbeds`, with the real parts."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.testbed.docker_testbed import DockerTestbed
from offboard.loadgen.testbed.local_testbed import HOG, LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from tests.testbeds import CONTRACT, Bench, keep, setups

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A testbed with cloud and relay started, and robots that can be started."""
    out = tmp_path_factory.mktemp("local")
    with LocalTestbed(out, setups(out)) as bed:
        bed.start()

        def cpu(part: str) -> tuple[float, float]:
            processes = [bed.children[part], *bed.hogs.get(part, ())]
            used_s = sum(time.clock_gettime((~one.process.pid << 3) | 2) for one in processes)
            return time.monotonic(), used_s

        yield Bench(bed, cpu, lambda _: len(hogs()))
    assert hogs() == []


def hogs() -> list[int]:
    """The process ids of live hogs of this process; zombies have no command line."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and HOG.encode() in (process / "cmdline").read_bytes():
                found.append(int(process.name))
    return found


@pytest.mark.parametrize("sentence", CONTRACT, ids=lambda sentence: sentence.__name__)
def test_the_local_testbed_keeps_the_contract(bench: Bench, sentence: Callable[[Bench], None]) -> None:
    """Each sentence of the contract holds with local processes."""
    keep(bench, sentence)


def test_an_unknown_flag_is_reported_in_the_words_of_the_part(tmp_path: Path) -> None:
    """A part that does not know a flag ends, and its message becomes a ConfigError."""
    with (
        LocalTestbed(tmp_path, {"wan": Setup({"dely_ms": 1.0})}) as bed,
        pytest.raises(
            ConfigError, match=r"^loadgen wan: unrecognized arguments: --dely-ms=1.0; did you mean --delay-ms"
        ),
    ):
        bed.start("wan")


def test_the_docker_testbed_needs_an_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If no Docker engine answers, a ConfigError of one line says so."""
    monkeypatch.setenv("DOCKER_HOST", "tcp://127.0.0.1:1")
    with (
        pytest.raises(ConfigError, match=r"^--testbed: docker: the engine does not answer: .*$"),
        DockerTestbed(tmp_path),
    ):
        pass
