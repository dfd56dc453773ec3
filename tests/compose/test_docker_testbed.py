"""The Docker testbed keeps the testbed contract of `tests.testbeds`, and leaves nothing behind."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.testbed.docker_engine import OWNER
from offboard.loadgen.testbed.docker_testbed import DockerTestbed
from offboard.loadgen.testbed.testbed import Setup
from tests.compose.conftest import ROOT, docker, made_by_docker
from tests.testbeds import CONTRACT, Bench, keep, setups, start

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600), pytest.mark.usefixtures("engine")]

END_S = 60.0
HOG = "/tmp/hog-"  # only commands of hogs contain this
READINGS = 10
ROUNDS = 4
# A testbed in its own process, until it is ended.
HOST = """
import signal, sys, time
from datetime import datetime
from pathlib import Path
from offboard.loadgen.testbed.docker_testbed import DockerTestbed
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores Ctrl-C
with DockerTestbed(Path(sys.argv[1])) as bed:
    bed.start("wan")
    print(bed.run, flush=True)
    time.sleep(600)
"""


def cpu(bed: DockerTestbed, part: str) -> tuple[float, float]:
    """The time of the reading, which is earlier than now, and the CPU seconds that the part had used."""
    stats = bed.containers[part].stats(stream=False, one_shot=True)
    second, _, rest = stats["read"].removesuffix("Z").partition(".")  # Python 3.10 reads no nanoseconds
    read_s = datetime.fromisoformat(f"{second}+00:00").timestamp() + float(f"0.{rest}")
    return read_s, stats["cpu_stats"]["cpu_usage"]["total_usage"] / 1e9


@pytest.fixture(scope="module")
def bench(engine: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:  # noqa: ARG001
    """A testbed with cloud and relay started, and robots that can be started."""
    out = tmp_path_factory.mktemp("docker")
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).chdir(ROOT)
        bed = stack.enter_context(DockerTestbed(out, setups(out)))
        bed.start()

        def hogs(part: str) -> int:
            if bed.exit_code(part) is not None:
                return 0
            return docker("top", name(bed, part), "-eo", "pid,args").count(HOG)

        yield Bench(bed, partial(cpu, bed), hogs)
    assert made_by_docker(bed.run) == []


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Callable[[], tuple[subprocess.Popen[str], str]]]:
    """Factory: starts a process with a testbed; the process, and the run of its testbed."""
    with contextlib.ExitStack() as stack:

        def run_host() -> tuple[subprocess.Popen[str], str]:
            process = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", HOST, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=ROOT
                )
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            run = process.stdout.readline().strip()
            assert len(made_by_docker(run)) == 4, "a container and three networks"
            return process, run

        yield run_host


def name(bed: DockerTestbed, part: str) -> str:
    return str(bed.containers[part].name)


@pytest.mark.parametrize("sentence", CONTRACT, ids=lambda sentence: sentence.__name__)
def test_the_docker_testbed_keeps_the_contract(bench: Bench, sentence: Callable[[Bench], None]) -> None:
    """Each sentence of the contract holds with containers."""
    keep(bench, sentence)


def test_an_unknown_flag_is_reported_in_the_words_of_the_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part that does not know a flag ends, its message becomes a ConfigError, and nothing is left."""
    monkeypatch.chdir(ROOT)
    with (
        DockerTestbed(tmp_path, {"wan": Setup({"dely_ms": 1.0})}) as bed,
        pytest.raises(
            ConfigError, match=r"^loadgen wan: unrecognized arguments: --dely-ms=1.0; did you mean --delay-ms"
        ),
    ):
        bed.start("wan")
    assert made_by_docker(bed.run) == []


def test_a_robot_can_reach_only_the_relay(bench: Bench) -> None:
    """On the network of the robots, the cloud has no name, and there is no way out."""
    bed = bench.bed
    assert isinstance(bed, DockerTestbed)
    try_all = (
        "import socket\n"
        "for host, port in (('wan', 5555), ('cloud', 5555), ('192.0.2.1', 80)):\n"
        "    try:\n"
        "        socket.create_connection((host, port), 3).close()\n"
        "        print(host, port)\n"
        "    except OSError:\n"
        "        pass\n"
    )
    start(bench, "robot-2")
    assert docker("exec", name(bed, "robot-2"), "python3", "-c", try_all) == "wan 5555"


def test_a_container_runs_as_our_user_with_a_short_quota_period(bench: Bench) -> None:
    """The parts run as the user of the testbed; quotas have a period of 10 ms, and none is set by `cpus`."""
    bed = bench.bed
    assert isinstance(bed, DockerTestbed)
    assert docker("exec", name(bed, "cloud"), "id", "-u") == str(os.getuid())
    limits = docker("inspect", "-f", "{{.HostConfig.CpuPeriod}} {{.HostConfig.NanoCpus}}", name(bed, "cloud"))
    assert limits == "10000 0"


@pytest.mark.usefixtures("engine")
def test_a_usage_reading_costs_less_than_docker_exec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reading takes less than half of the CPU time of an empty `docker exec`."""
    monkeypatch.chdir(ROOT)
    read_s, executed_s = [], []
    with DockerTestbed(tmp_path, setups(tmp_path)) as bed:  # only a relay, without traffic
        bed.start("wan")
        bed.usage("wan")
        for _ in range(ROUNDS):  # the start of the relay adds to some of them
            _, began_s = cpu(bed, "wan")
            for _ in range(READINGS):
                bed.usage("wan")
            _, between_s = cpu(bed, "wan")
            for _ in range(READINGS):
                docker("exec", name(bed, "wan"), "true")
            _, ended_s = cpu(bed, "wan")
            read_s.append(between_s - began_s)
            executed_s.append(ended_s - between_s)
    print(read_s, executed_s)
    assert min(read_s) < min(executed_s) / 2


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_testbed_leaves_nothing(host: Callable[..., tuple], stop: signal.Signals) -> None:
    """After Ctrl-C or SIGTERM, even twice, no container or network is left once the testbed has ended."""
    process, run = host()
    process.send_signal(stop)
    process.send_signal(stop)
    process.wait(END_S)
    assert made_by_docker(run) == []


def test_the_next_testbed_removes_what_a_killed_one_left(
    host: Callable[..., tuple], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next testbed removes what a killed testbed left behind, but not what a running one uses."""
    killed, left = host()
    killed.kill()
    killed.wait(END_S)
    assert made_by_docker(left) != []
    monkeypatch.chdir(ROOT)
    with DockerTestbed(tmp_path / "first") as first:
        assert made_by_docker(left) == []
        with DockerTestbed(tmp_path / "second"):
            assert len(made_by_docker(first.run)) == 3, "its networks"
            assert docker("network", "ls", "--filter", f"label={OWNER}", "--quiet").split()
    assert made_by_docker(first.run) == []
