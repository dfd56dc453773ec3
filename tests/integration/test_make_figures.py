"""`make figures` in a small checkout with steps of its own: what it measures, and how it ends."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.figures.step import FOLDER, ROOT, STEPS

STEP = """
[[section.step]]
name = "{name}"
title = "{name}"
about = "About."
minutes = 1
environment = "{environment}"
run = {run}
"""
LIMIT_S = 60.0


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with the code of this one, and no pages but that of the results."""
    root = tmp_path / "checkout"
    shutil.copytree(ROOT / "benchmarks" / "figures", root / "benchmarks" / "figures")
    shutil.copy(ROOT / "benchmarks" / "__init__.py", root / "benchmarks")
    for name in ("offboard", "common", "robot_client", "cloud_server", "loadgen"):
        (root / name).symlink_to(ROOT / name)
    (root / FOLDER).mkdir(parents=True)
    (root / "README.md").touch()
    (root / ".gitignore").write_text("out/\n__pycache__/\n")
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for words in (["init", "--quiet"], ["add", "."], [*author, "commit", "--quiet", "-m", "All"]):
        subprocess.run(["git", *words], cwd=root, check=True)
    return root


def step(name: str, *commands: str, more: str = "") -> str:
    return STEP.format(name=name, environment=sys.prefix, run=json.dumps(commands)) + more


def started(root: Path, *steps: str, flags: tuple[str, ...] = ()) -> "subprocess.Popen[str]":
    """The program, which measures these steps."""
    (root / STEPS).write_text("".join(['[[section]]\npage = "s"\ntitle = "S"\n', *steps]))
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.figures", *flags],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(root: Path, *steps: str, flags: tuple[str, ...] = ()) -> tuple[int, str]:
    """Its exit code, and what it printed."""
    process = started(root, *steps, flags=flags)
    said, _ = process.communicate(timeout=LIMIT_S)
    return process.returncode, said


def test_tables_of_rows_follow_rows_that_the_same_call_measures(checkout: Path) -> None:
    """Whether a step is up to date is asked when its turn comes; a second call measures nothing."""
    for name, text in {"rows.csv": "old", "new.csv": "new", "rows.json": '{"commit": "abc1234"}'}.items():
        (checkout / "docs" / name).write_text(text)
    steps = (
        step("rows", "cp -v docs/new.csv docs/rows.csv"),
        step("table", "cat docs/rows.csv", more='reads = ["docs/rows.csv"]\n'),
    )
    for flags, shown in ((("--only", "table"), ["old"]), ((), ["new"])):
        code, said = run(checkout, *steps, flags=flags)
        assert code == 0, said
        assert json.loads((checkout / FOLDER / "table.json").read_text())["output"] == shown
    assert run(checkout, *steps) == (0, "")


def test_nothing_is_kept_if_the_code_changes_meanwhile(checkout: Path) -> None:
    """Neither the file nor the picture; --list says so too."""
    picture = step(
        "picture",
        "cp -v README.md {out}/a.svg",
        "cp -v README.md code.py",
        more='copies = { "{out}/a.svg" = "docs/a.svg" }\n',
    )
    code, said = run(checkout, picture)
    assert code == 1
    assert "the code is no longer that of commit" in said
    assert not (checkout / "docs" / "a.svg").exists()
    assert not (checkout / FOLDER / "picture.json").exists()
    code, said = run(checkout, picture, flags=("--list",))
    assert code == 0
    assert said.splitlines()[-1] == "the code was changed: commit code.py first"
    (checkout / "code.py").unlink()
    assert (
        run(checkout, step("picture", "cp -v README.md {out}/a.svg", more=picture.splitlines()[-1]))[0] == 0
    )
    assert (checkout / "docs" / "a.svg").exists()


@pytest.fixture
def heard() -> Iterator[None]:
    """A hang-up is not ignored, as it is when the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_command_under_way(checkout: Path, number: signal.Signals) -> None:
    """No process of it is left, and the exit code is 130. Until then, a second call is refused."""
    endless = step("endless", "sh -c 'echo $$ > out/pid; sleep 1000'")
    process, pid = started(checkout, endless), checkout / "out" / "pid"
    end_s = time.monotonic() + LIMIT_S
    while not (pid.exists() and pid.read_text().strip()) and time.monotonic() < end_s:
        time.sleep(0.05)
    group = int(pid.read_text())
    os.killpg(group, 0)
    code, said = run(checkout, endless)
    assert code == 2
    assert said.endswith("another `make figures` measures here: wait until it has ended\n")
    process.send_signal(number)
    said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130
    assert said.endswith("interrupted\n")
    with pytest.raises(ProcessLookupError):
        os.killpg(group, 0)
