"""`@task(version=..., covers=...)`: what counts as source besides the functions of a task itself."""

import importlib
import itertools
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from offboard.common import VERSION, tasks
from offboard.common.errors import ConfigError
from offboard.common.source import covers
from offboard.common.source.comparison import (
    difference,
    is_reading,
    kind_in_use,
    not_compared,
    read_files_of_robot,
    read_files_of_server,
    uncovered,
)
from offboard.common.source.covers import COVERS_MAX, VERSION_LENGTH_MAX, CoveredFiles
from offboard.common.tasks import Kind, hashes, kind_named, kind_of, task
from offboard.robot_client.check.network import StepFailed
from offboard.robot_client.check.task_comparison import compare
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

MODULE = """from offboard.common.tasks import task

FACTOR = 2

def helper(x):
    return x * 2

def other(x):
    return helper(x)

class Model:
    def run(self, x):
        return other(x)

    @property
    def size(self):
        return inner()

def inner(): return 1

def load():
    return Model()

@task("covering", size=float, setup=load, version={version!r}, covers={covers})
def covering(model, x):
    return [helper(one) for one in model.run(x)] + helper(FACTOR)
"""

NUMBERS = itertools.count()  # of modules: a name is imported once in a process

Made = Callable[..., Kind]


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Made]:
    """Factory: the kind of MODULE with this version and covers, and with each `old` text replaced."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(tasks, "_kinds", {})
    monkeypatch.setattr(tasks, "_on_servers", {})

    def make(covers: str = "()", version: object = "", **replaced: str) -> Kind:
        text = MODULE.format(version=version, covers=covers)
        for number, old in enumerate(replaced.get("old", "").split("|")):
            text = text.replace(old, replaced["new"].split("|")[number]) if old else text
        name = f"covering_{next(NUMBERS)}"
        (tmp_path / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        tasks._kinds.clear()  # the task has the same name in each module
        tasks._on_servers.clear()
        module: ModuleType = importlib.import_module(name)
        return kind_of(module.covering)

    return make  # type: ignore[return-value]


def test_a_changed_helper_counts_if_it_is_covered(made: Made) -> None:
    """Without covers= a changed helper has the same hash; this is what users must know."""
    change = {"old": "x * 2", "new": "x * 4"}
    assert made().source_hash == made(**change).source_hash
    assert made("(helper,)").source_hash != made("(helper,)", **change).source_hash
    assert made("(helper,)").source_hash == made("(helper,)", old="x * 2", new="(x * 2)  # x").source_hash


def test_a_changed_class_counts_if_it_is_covered(made: Made) -> None:
    """So does one of its methods."""
    change = {"old": "return inner()", "new": "return 3"}
    assert made("[Model]").source_hash == made("[Model]").source_hash != made("[Model]", **change).source_hash


def test_the_version_counts() -> None:
    """A number is the same as its text."""

    def versioned(x: float) -> float:
        return x

    found = []
    for name, version in (("v_a", "2"), ("v_b", 2), ("v_c", 3), ("v_d", "")):
        task(name, size=float, version=version)(versioned)  # type: ignore[arg-type]
        found.append(kind_named(name).source_hash)
    assert found[0] == found[1]
    assert len(set(found)) == 3


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"version": True}, "version= is True; it must be a text or a whole number"),
        ({"version": 1.5}, "version= is 1.5; it must be a text or a whole number"),
        ({"version": "x" * 65}, f"version= has over {VERSION_LENGTH_MAX} characters"),
        ({"covers": "model.onnx"}, "covers= is 'model.onnx'; it must be a tuple of functions, classes and"),
        ({"covers": abs}, "covers= is <built-in function abs>; it must be a tuple of functions, classes"),
        ({"covers": (3,)}, "covers= has 3, no function, class or path of a file"),
        ({"covers": (abs,)}, "covers= has <built-in function abs>, whose source cannot be read"),
        ({"covers": ("a",) * 65}, f"covers= has 65 items; at most {COVERS_MAX} are allowed"),
        ({"covers": {"cloud": ()}}, "covers= names the site 'cloud'; the task has no site"),
    ],
)
def test_what_cannot_be_covered_is_refused(given: dict[str, Any], said: str) -> None:
    """One line names the task, the option, the value and what is allowed; nothing is registered."""

    def covering(x: float) -> float:
        return x

    with pytest.raises(ConfigError) as caught:
        task("never_covered", size=float, **given)(covering)
    assert str(caught.value).startswith(f"task never_covered: {said}")
    assert "never_covered" not in hashes()


def test_a_file_is_read_at_the_first_use(made: Made, tmp_path: Path) -> None:
    """Neither the decorator nor a `hello` needs it; it is found next to the module, and read once."""
    kind = made("('model.bin',)")
    assert hashes()["covering"] == kind.source_hash
    with pytest.raises(ConfigError) as caught:
        kind_in_use(kind.function)
    assert str(caught.value) == (
        f"task covering: covers= names {tmp_path / 'model.bin'}: No such file or directory"
    )
    (tmp_path / "model.bin").write_bytes(b"weights")
    assert kind_in_use(kind.function) is kind
    read_files_of_robot(kind)
    first = kind.fingerprint
    assert first.startswith(kind.source_hash)
    assert (len(first), first) == (128, hashes()["covering"])
    (tmp_path / "model.bin").write_bytes(b"other")
    read_files_of_robot(kind)
    assert kind.fingerprint == first
    other = made("('model.bin',)")
    read_files_of_server()
    assert other.fingerprint[:64] == first[:64]
    assert other.fingerprint[64:] != first[64:]


def test_the_order_of_files_counts(tmp_path: Path) -> None:
    """Only the contents count, in the order of covers=; where a file ends counts too."""
    for name, text in (("a", b"12"), ("b", b"3"), ("c", b"1"), ("d", b"23"), ("e", b"12")):
        (tmp_path / name).write_bytes(text)

    def digest(*names: str) -> str:
        files = CoveredFiles("ordered", [tmp_path / name for name in names])
        files.read()
        return files.digest

    assert digest("a", "b") == digest("e", "b")
    assert len({digest("a", "b"), digest("b", "a"), digest("c", "d")}) == 3


@pytest.mark.parametrize("made_by", [os.mkdir, os.mkfifo], ids=["folder", "fifo"])
def test_what_is_no_file_is_refused_and_never_waited_for(
    made_by: Callable[[Path], None], tmp_path: Path
) -> None:
    """A FIFO would be read for ever."""
    made_by(tmp_path / "model")
    files = CoveredFiles("odd", [tmp_path / "model"])
    with pytest.raises(ConfigError, match=r"task odd: covers= names .*/model: is a .*, not a plain file"):
        files.begin()


def test_a_file_over_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before it is read, or while it grows."""
    monkeypatch.setattr(covers, "FILE_BYTES_MAX", 3)
    path = tmp_path / "model"
    path.write_bytes(b"1234")
    with pytest.raises(ConfigError, match=r"model: over .* GiB; use version= for such a file"):
        CoveredFiles("large", [path]).begin()
    path.write_bytes(b"123")
    grows = CoveredFiles("large", [path])
    monkeypatch.setattr(grows, "_check", lambda path: path.write_bytes(b"1234"))
    with pytest.raises(ConfigError, match=r"model: over .* GiB; use version= for such a file"):
        grows.read()


def test_a_file_is_read_in_pieces(tmp_path: Path) -> None:
    """Reading 64 MiB takes less memory than three pieces."""
    import tracemalloc

    path = tmp_path / "model"
    with path.open("wb") as file:
        file.truncate(64 * covers.PIECE_BYTES)
    files = CoveredFiles("large", [path])
    tracemalloc.start()
    try:
        files.read()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert files.digest
    assert peak < 3 * covers.PIECE_BYTES, peak


def test_a_file_that_cannot_be_read_to_its_end_keeps_the_task_onboard(
    made: Made, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is logged once; the caller of a task gets no error, because onboard can answer."""
    (tmp_path / "model.bin").write_bytes(b"weights")
    kind = made("('model.bin',)")
    files = kind.covers.files
    assert files is not None
    check = files._check
    files._check = lambda path: (check(path), path.unlink())[0]  # type: ignore[method-assign, func-returns-value]
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            kind_in_use(kind.function)
            assert files._reader is not None
            files._reader.join()
    why = f"task covering: covers= names {tmp_path / 'model.bin'}: No such file or directory"
    assert difference(kind, CLOUD, {"covering": kind.source_hash}) == why
    assert [record.getMessage().split("; ")[0] for record in caplog.records] == [
        f"{why}: this task stays onboard"
    ]


def test_a_slow_file_keeps_no_call_waiting(made: Made, tmp_path: Path) -> None:
    """While it is read, the server is left out, and says why; then the contents are compared."""
    (tmp_path / "model.bin").write_bytes(b"weights")
    kind, go_on = made("('model.bin',)"), threading.Event()
    files = kind.covers.files
    assert files is not None
    digest = files._digest
    files._digest = lambda *given: (go_on.wait(), digest(*given))[1]  # type: ignore[method-assign]
    kind_in_use(kind.function)
    there = {"covering": kind.source_hash + "f" * 64}
    assert is_reading(kind)
    assert difference(kind, CLOUD, there) == "the files that covering covers are being read"
    go_on.set()
    read_files_of_robot(kind)
    assert not is_reading(kind)
    assert difference(kind, CLOUD, there) == "model.bin, which covering covers, differs on the server"
    assert difference(kind, CLOUD, hashes()) is None


def test_other_source_is_said_before_files_are_read(made: Made, tmp_path: Path) -> None:
    """A server with another helper is told apart from one with another model."""
    (tmp_path / "model.bin").write_bytes(b"weights")
    kind = made("(helper, 'model.bin')")
    there = {"covering": "f" * 128}
    assert difference(kind, CLOUD, there) == (
        "the source of task covering or the code that it covers differs on the server"
    )


VARIANTS = """from offboard.common.tasks import task

def small(x): return x
def near(x): return x

@task("by_site", size=float, variants={{"onboard": small}}, quality={{"onboard": 0.5, "cloud": 1.0}},
      covers={covers})
def large(x): return x
"""


@pytest.fixture
def by_site(tmp_path: Path, made: Made) -> Callable[[str], Kind]:
    """Factory: a kind with variants that covers this."""
    assert made  # it has put the folder on the path, and an empty registry in place

    def make(covers: str) -> Kind:
        name = f"by_site_{next(NUMBERS)}"
        (tmp_path / f"{name}.py").write_text(VARIANTS.format(covers=covers))
        importlib.invalidate_caches()
        tasks._kinds.clear()
        tasks._on_servers.clear()
        return kind_of(importlib.import_module(name).large)

    return make


def test_a_robot_need_not_have_the_model_of_a_server(by_site: Callable[[str], Kind], tmp_path: Path) -> None:
    """Its own model must be there; that of the server is then not compared, and `check` says so."""
    kind = by_site("{'onboard': ('small.bin',), 'cloud': (near, 'large.bin')}")
    with pytest.raises(ConfigError, match=r"task by_site: covers= names .*/small\.bin: No such file"):
        kind_in_use(kind.function)
    (tmp_path / "small.bin").write_bytes(b"s")
    read_files_of_robot(kind)
    there = hashes() | {"by_site@cloud": kind.at(CLOUD).source_hash + "f" * 64}
    assert difference(kind, CLOUD, there) is None
    assert "by_site@cloud (its files are not on this robot)" in not_compared([kind])
    other = there | {"by_site@cloud": "f" * 128}
    said = "the source of by_site@cloud, a variant of task by_site, differs on the server"
    assert difference(kind, CLOUD, other) == said
    assert len(kind.at(ONBOARD).fingerprint) == 128
    with pytest.raises(ConfigError, match=r"task by_site: covers= names .*/large\.bin: No such file"):
        read_files_of_server()


def test_a_model_of_the_server_that_the_robot_has_is_compared(
    by_site: Callable[[str], Kind], tmp_path: Path
) -> None:
    """A server does not need the model of the robot."""
    kind = by_site("{'onboard': ('small.bin',), 'cloud': ('large.bin',)}")
    (tmp_path / "large.bin").write_bytes(b"l")
    read_files_of_server()
    there = hashes()
    assert {name: len(one) for name, one in there.items()} == {"by_site": 64, "by_site@cloud": 128}
    (tmp_path / "small.bin").write_bytes(b"s")
    read_files_of_robot(kind)
    assert difference(kind, CLOUD, there) is None
    there["by_site@cloud"] = kind.at(CLOUD).source_hash + "f" * 64
    assert difference(kind, CLOUD, there) == "large.bin, which by_site@cloud covers, differs on the server"


def test_covers_that_are_not_by_site_belong_to_all_variants(by_site: Callable[[str], Kind]) -> None:
    """They are part of what is always compared."""
    kinds = [by_site(covers) for covers in ("()", "(near,)")]
    assert kinds[0].source_hash != kinds[1].source_hash
    assert kinds[0].at(ONBOARD).source_hash == kinds[1].at(ONBOARD).source_hash


def test_helpers_that_are_called_and_not_covered_are_named_once(made: Made) -> None:
    """Those of setups, methods and helpers too; not the task itself, constants or other modules."""
    kind = made()
    names = ["helper", "Model", "other", "inner"]
    assert sorted(uncovered([kind, kind])) == sorted(f"{kind.function.__module__}.{one}" for one in names)
    assert not uncovered([made("(helper, Model, other, inner)")])
    said = compare([made("(Model, other, inner)")], hashes(), chosen=True)
    assert said.count("helper") == 1
    assert said.endswith(
        ".helper (called, but in no covers=); constants, other modules, libraries, and files in no covers="
    )


def test_many_helpers_are_counted(made: Made) -> None:
    """The line names twenty of them."""
    calls = " + ".join(f"h{n}(x)" for n in range(25))
    more = "\n".join(f"def h{n}(x): return x" for n in range(25))
    kind = made("(Model,)", old="x * 2|FACTOR = 2", new=f"{calls}|{more}")
    assert " and 8 more (called, but in no covers=)" in not_compared([kind])


@pytest.mark.parametrize("software", ["0.1.0", "0.3.0\nforged"])
def test_another_version_of_offboard_is_named(made: Made, software: str) -> None:
    """Versions may hash the same text in other ways, so both are named, in one line."""
    kind = made()
    there = {"covering": "f" * 64}
    shown = software.replace("\n", "\\n")
    both = f"Offboard {shown} there, {VERSION} here"
    said = difference(kind, CLOUD, there, software)
    assert said == (
        f"the source of task covering differs on the server, or is only hashed in another way: {both}"
    )
    with pytest.raises(StepFailed) as caught:
        compare([kind], there, chosen=True, software=software)
    assert both in str(caught.value)
    assert "; remedy: install the same version of Offboard and of " in str(caught.value)
    assert difference(kind, CLOUD, hashes(), software) is None


def test_the_example_of_the_docs_covers_its_helper_and_its_file(tmp_path: Path, made: Made) -> None:
    """`docs/own_task.md` shows a task of which no helper is left out."""
    assert made
    text = (Path(__file__).parents[2] / "docs/own_task.md").read_text()
    example = text.split("```python\n# mygrader.py\n")[1].split("```")[0]
    (tmp_path / "mygrader.py").write_text(example)
    (tmp_path / "weights.txt").write_text("3")
    importlib.invalidate_caches()
    grader = importlib.import_module("mygrader")
    kind = kind_in_use(grader.grade)
    read_files_of_robot(kind)
    assert len(kind.fingerprint) == 128
    assert uncovered([kind]) == []
    assert grader.grade(grader.load_weights(), [1.0, 2.0]) == 18.0
