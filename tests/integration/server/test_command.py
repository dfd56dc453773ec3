"""The command `cloud-server`: wrong flags and --help."""

import subprocess
import sys
from pathlib import Path

import pytest

from offboard.cloud_server.http_api import HttpServer, create_app
from tests.integration.server.peers import ROOT, WAIT_S, Serve, start

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (["--listen", "{zmq}"], "--listen: '{zmq}' cannot be bound: Address already in use"),
        (["--http", "127.0.0.1:{http}"], "--http: 127.0.0.1:{http} cannot be bound: Address already in use"),
        (["--listen", "udp://x:1"], "--listen: 'udp://x:1' is not tcp://HOST:PORT or tcp://*:PORT with"),
        (["--listen", "tcp://x:65536"], "--listen: 'tcp://x:65536' is not tcp://HOST:PORT"),
        (["--http", "8000"], "--http: '8000' is not HOST:PORT with a port 0 to 65535"),
        (["--workers", "0"], "--workers: 0 is below 1, the minimum"),
        (["--executor", "fibres"], "--executor: 'fibres' is not one of threads, processes, ray"),
        (["--blob-mib", "1"], "--blob-mib: 1 is below --message-mib 64; a large argument would never fit"),
        (
            ["--executor", "processes", "--worker-memory", "256"],
            "--worker-memory: 256 is below --blob-mib 256 and twice --message-mib 64, which a worker needs",
        ),
        (["--tasks", "no_such_module"], "task module 'no_such_module' cannot be imported"),
    ],
)  # fmt: skip
def test_a_wrong_flag_is_one_line_and_exit_code_2(
    serve: Serve, folder: Path, flags: list[str], error: str
) -> None:
    """The line names the flag, its value and what is allowed; there is no traceback."""
    running = serve()
    web = HttpServer(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", 0))
    ports = {
        "zmq": running.server.endpoint,
        "http": web.address.rpartition(":")[2],
    }
    process = start(folder, "--log", "error", *(flag.format(**ports) for flag in flags))
    _, text = process.communicate(timeout=WAIT_S)
    web.close()
    assert process.returncode == 2, text
    assert text.startswith(f"cloud-server: {error.format(**ports)}")
    assert text.count("\n") == 1


def test_help_imports_no_heavy_library() -> None:
    """--help works without importing zmq, numba, numpy and fastapi."""
    code = (
        "import sys; from offboard.cloud_server.__main__ import serve\n"
        "try: serve(['--help'], {})\n"
        "except SystemExit: print({'zmq', 'numba', 'fastapi', 'numpy'} & set(sys.modules))"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=WAIT_S, check=True
    ).stdout
    assert "--listen ENDPOINT" in shown
    assert shown.endswith("set()\n")
