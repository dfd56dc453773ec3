"""The commit of measured figures: that of the code, whatever happens to files that no measurement needs."""

import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.figures import code_of_step
from benchmarks.figures.code_of_step import benchmarks_of, commit_of
from offboard.loadgen.play.machine import changed_code, commit_here

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="no git; remedy: apt-get install git")


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with one commit, which is the current folder."""
    monkeypatch.chdir(tmp_path)
    for name, value in {"NAME": "a", "EMAIL": "a@example.org"}.items():
        monkeypatch.setenv(f"GIT_AUTHOR_{name}", value)
        monkeypatch.setenv(f"GIT_COMMITTER_{name}", value)
    git("init", "--quiet")
    commit("code.py", "1")
    return tmp_path


def git(*words: str) -> str:
    return subprocess.run(["git", *words], check=True, capture_output=True, text=True).stdout


def commit(name: str, text: str) -> None:
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Path(name).write_text(text)
    git("add", ".")
    git("commit", "--quiet", "-m", name)


@pytest.mark.parametrize(
    "name",
    [
        "docs/figures/a.json",
        "docs/page.md",
        "README.md",
        "mkdocs.yml",
        "tests/unit/test_a.py",
        "tests/ray/a.py",
        "loadgen/scenarios/a.toml",
    ],
)
def test_files_that_no_measurement_needs_do_not_change_it(checkout: Path, name: str) -> None:
    """Neither a commit of such a file, nor a change of it."""
    first = commit_here()
    assert first is not None
    assert git("rev-parse", "HEAD").startswith(first)
    commit(name, "1")
    (checkout / name).write_text("2")
    assert commit_here() == first
    assert changed_code() == []


def test_a_change_of_code_is_seen(checkout: Path) -> None:
    """A changed file, a new file and a new commit are, and the files are named."""
    first = commit_here()
    (checkout / "code.py").write_text("2")
    (checkout / "folder").mkdir()
    (checkout / "folder" / "new.py").write_text("1")
    assert changed_code() == ["code.py", "folder/new.py"]
    assert commit_here() == f"{first}-dirty"
    commit("code.py", "3")
    assert commit_here() not in (first, f"{first}-dirty")
    assert git("rev-parse", "HEAD").startswith(str(commit_here()))


def test_the_goals_by_ros_2_are_code(checkout: Path) -> None:
    """They are measured by a test."""
    first = commit_here()
    commit("tests/ros2/test_goals.py", "1")
    (checkout / "tests" / "ros2" / "test_goals.py").write_text("2")
    assert changed_code() == ["tests/ros2/test_goals.py"]
    assert commit_here() != first


def test_a_git_that_fails_does_not_mean_unchanged(checkout: Path) -> None:
    """If git cannot read what was committed, the commit is unknown."""
    (checkout / ".git" / "index").write_bytes(b"broken")
    assert changed_code() is None
    assert commit_here() is None


def test_outside_a_checkout_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the figures have no commit."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert commit_here() is None


def test_a_step_runs_the_benchmarks_that_it_names_and_those_that_they_import() -> None:
    """Also by a path in a string, and as a table of `python -m benchmarks`; no other benchmarks."""

    def names(*commands: str) -> set[str]:
        return {path.stem for path in benchmarks_of(commands)}

    assert names("loadgen compare calm --policies default") == set()
    assert names("python -m benchmarks.streams .cache/links/cicv5g") == {"streams", "measure"}
    assert {"ablations", "left_out", "against", "simulated_sets"} <= names("python -m benchmarks.ablations")
    decision = names("python -m benchmarks decision")
    assert {"__main__", "decision", "measure"} <= decision
    assert decision.isdisjoint({"streams", "ablations", "claims_of_others", "pipeline"})


@pytest.mark.usefixtures("checkout")
def test_a_change_of_one_benchmark_makes_only_its_own_steps_older() -> None:
    """The commit of a step is the last one of the product, or of a benchmark that it runs."""

    def commits() -> list[str | None]:
        for asked in (code_of_step._last, code_of_step._place):
            asked.cache_clear()
        return [commit_of([one]) for one in ("loadgen table", "python -m benchmarks.streams X")]

    def head() -> str:
        return git("rev-parse", "--short=12", "HEAD").strip()

    try:
        product = head()
        assert commits() == [product, product]
        commit("benchmarks/pipeline.py", "1")
        assert commits() == [product, product]
        commit("benchmarks/streams.py", "1")
        assert commits() == [product, head()]
        commit("code.py", "2")
        assert commits() == [head(), head()]
    finally:
        for asked in (code_of_step._last, code_of_step._place):
            asked.cache_clear()
