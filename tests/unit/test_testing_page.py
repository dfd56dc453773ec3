"""The tests of docs/testing.md: the first passes if a program survives a dead cloud, and fails for others."""

import importlib
import itertools
import re
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.errors import CloudTimeout

DOCS = Path(__file__).parents[2] / "docs"
MODULES = ("mytasks", "robot", "test_robot", "test_main")
LINES_MAX = 20
CALL = "return offload(count_primes, limit)"
numbers = itertools.count()


def shown(page: str) -> dict[str, str]:
    """The modules that a page shows, by name."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return dict(re.findall(r"```python\n# (\w+)\.py\n(.*?)```", text, re.DOTALL))


PAGE = {**shown("offload.md"), **shown("testing.md")}
TEST = PAGE["test_robot"]


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Callable[[], None]]:
    """Returns the test of the page for a program whose call, and whose decorator, are these."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)

    def make(call: str = CALL, options: str = "") -> Callable[[], None]:
        assert CALL in PAGE["robot"]
        (tmp_path / "robot.py").write_text(PAGE["robot"].replace(CALL, call))
        assert '@task("count_primes", ' in PAGE["mytasks"]
        decorator = f'@task("page_{next(numbers)}", {options}'  # a process has one task of each name
        (tmp_path / "mytasks.py").write_text(PAGE["mytasks"].replace('@task("count_primes", ', decorator))
        for test in ("test_robot", "test_main"):
            (tmp_path / f"{test}.py").write_text(PAGE[test])
        found: Callable[[], None] = importlib.import_module("test_robot").test_the_robot_survives_a_dead_cloud
        return found

    return make


def refuse(*_: object, **__: object) -> None:
    raise AssertionError("a test with the kit waits in real time")


def test_the_test_is_short() -> None:
    """It has at most 20 lines, with its imports."""
    assert len(TEST.strip().splitlines()) <= LINES_MAX


def test_a_program_that_survives_passes_without_waiting(
    program: Callable[..., Callable[[], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program of the page passes, and no thread sleeps or waits meanwhile."""
    test = program()
    monkeypatch.setattr(time, "sleep", refuse)
    monkeypatch.setattr(threading.Condition, "wait", refuse)
    test()


def test_a_program_that_connects_by_itself_gets_the_bench(
    program: Callable[..., Callable[[], None]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The second test of the page passes, and the program has printed all its answers."""
    program()
    importlib.import_module("test_main").test_the_program_ends_although_the_cloud_dies(monkeypatch)
    assert len(capsys.readouterr().out.splitlines()) == 100


@pytest.mark.parametrize(
    ("call", "options", "error"),
    [
        ('return offload(count_primes, limit, where="cloud")', "", AssertionError),
        ('return offload(count_primes, limit, where="cloud", timeout_s=60.0)', "", AssertionError),
        ('primes = offload(count_primes, limit)\n    assert offload.last.used == "cloud"\n    return primes',
         "", AssertionError),
        (CALL, "duplicate=False, ", CloudTimeout),
    ],
    ids=["pinned", "patient", "cloud only", "never twice"],
)  # fmt: skip
def test_a_program_that_does_not_survive_fails(
    program: Callable[..., Callable[[], None]], call: str, options: str, error: type[Exception]
) -> None:
    """It waits for its timeouts, counts on the cloud, or its task cannot be repeated onboard."""
    with pytest.raises(error):
        program(call, options)()
