"""The `main` of the examples against a real server."""

import contextlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROOT = Path(__file__).parents[2]
CALLS = 30
RUN_S = 60.0
# Each application that CI runs: the library, and the executor that its docstring asks for.
APPLICATIONS = {"apriltags": ("pupil_apriltags", "threads"), "registration": ("small_gicp", "processes")}


@contextlib.contextmanager
def server(tasks: str, executor: str) -> Iterator[str]:
    """A server with one worker, and its endpoint."""
    command = [sys.executable, "-m", "offboard.cloud_server", "--tasks", tasks, "--executor", executor]
    command += ["--workers", "1", "--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0"]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            ready = next(line for line in process.stderr if "listening on" in line)
            yield ready.split("listening on ")[1].split(",")[0]
        finally:
            process.kill()


@pytest.mark.parametrize("name", APPLICATIONS)
def test_an_example_says_where_each_call_ran(name: str) -> None:
    """Every call is answered, its line names site and reason, and the process ends without a crash."""
    library, executor = APPLICATIONS[name]
    pytest.importorskip(library, reason=f"needs the extra '{name}': pip install '.[{name}]'")
    with server(f"examples.{name}", executor) as endpoint:
        done = subprocess.run(
            [sys.executable, "-m", f"examples.{name}", endpoint],
            capture_output=True,
            text=True,
            timeout=RUN_S,
            cwd=ROOT,
        )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == CALLS
    assert all(re.search(r"(onboard|cloud).* ms \(.+\)$", line) for line in lines), lines
