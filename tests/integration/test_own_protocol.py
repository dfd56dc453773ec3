"""The runner of docs/extending.md, which drives a conversation over a pipe: it runs as the page shows it."""

import re
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import CloudTimeout, Overtaken
from offboard.common.tasks import Task, kind_of
from tests.probes import nap
from tests.programs import ROOT, RUN_S, output_of

pytestmark = pytest.mark.integration

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
LINES_MAX = 80
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
RUNNER = next(one for one in BLOCKS if one.startswith("# mypipe.py"))
PROGRAM = next(one for one in BLOCKS if "from mypipe import" in one)
# Answers each number with its double, after as many seconds as the number says.
DOUBLE = """import time
for line in iter(input, ""):
    i, n = map(int, line.split())
    time.sleep(n)
    print(i, 2 * n, flush=True)
"""


@pytest.fixture
def runner() -> Any:
    """The runner, connected to a program."""
    space: dict[str, Any] = {}
    exec(compile(RUNNER, "mypipe.py", "exec"), space)
    one = space["PipeRunner"]("program", [sys.executable, "-c", DOUBLE])
    yield one
    one.close()


def task(seconds: int) -> Task:
    return Task(kind_of(nap), (seconds,), seconds)


def test_it_is_short() -> None:
    """A protocol of one's own is a page of code."""
    assert len(RUNNER.splitlines()) <= LINES_MAX


def test_the_program_of_the_page_runs(tmp_path: Path) -> None:
    """It prints the answer of the program, and both sites."""
    (tmp_path / "mytasks.py").write_text(next(one for one in BLOCKS if one.startswith("# mytasks.py")))
    (tmp_path / "mypipe.py").write_text(RUNNER)
    (tmp_path / "main.py").write_text(PROGRAM)
    assert output_of(tmp_path / "main.py") == "5133 <Offloader onboard: 0 in flight; program: 0 in flight>\n"


def test_runs_end_in_every_way(runner: Any) -> None:
    """An answer, a budget that is over, a run that another site overtook, and a program that dies."""
    assert runner.submit(task(0), 30.0).result(RUN_S).value == 0
    late = runner.submit(task(30), 0.2).result(RUN_S)
    assert isinstance(late.failure, CloudTimeout)
    overtaken = task(1)
    future = runner.submit(overtaken, 30.0)
    runner.cancel(overtaken)
    assert isinstance(future.result(RUN_S).failure, Overtaken)
    future = runner.submit(task(2), 30.0)
    runner._program.kill()
    assert "the program has ended" in str(future.result(RUN_S).failure)
    end_s = time.monotonic() + RUN_S
    while runner.unavailable(kind_of(nap)) is None:
        assert time.monotonic() < end_s
    assert not runner.submit(task(0), 30.0).result(RUN_S).started
