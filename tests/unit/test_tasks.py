"""Registering tasks and finding them."""

from pathlib import Path

import pytest

from offboard.common.errors import BadValue, ConfigError, UnknownTask
from offboard.common.tasks import kind_named, kind_of, load_modules, task


@task("double", size=lambda number, scale=1: number * scale)
def double(number: float, scale: int = 1) -> float:
    return 2 * number * scale


def test_a_task_stays_a_function_and_is_found_by_name_and_function() -> None:
    """The decorator returns the function itself."""
    assert double(2) == 4
    assert kind_of(double) is kind_named("double")
    assert kind_of(double).function is double


def test_a_call_is_bound_as_python_binds_it() -> None:
    """Keywords and defaults become positional arguments."""
    assert kind_of(double).bind((3,), {"scale": 2}) == (3, 2)
    assert kind_of(double).bind((3,), {}) == (3, 1)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
def test_an_infinite_or_negative_size_is_refused(bad: float) -> None:
    """The input size d must be finite and not negative."""
    with pytest.raises(BadValue, match="task double: input size"):
        kind_of(double).size_of((bad, 1))


def test_a_kind_has_a_source_hash() -> None:
    """It has 64 characters, or none if the source cannot be read."""

    def register(name: str, body: str) -> str:
        space: dict[str, object] = {}
        exec(body, {"task": task}, space)
        return kind_named(name).source_hash

    # The source of code made by exec cannot be read.
    assert register("made_up", "@task('made_up', size=abs)\ndef made_up(x): return x") == ""
    assert len(kind_of(double).source_hash) == 64


@pytest.mark.parametrize("name", ["", "a b", "x" * 65, "1st", "../x", "a\nb"])
def test_a_bad_name_is_refused(name: str) -> None:
    """Names are short identifiers, because they appear in logs, metrics and messages."""
    with pytest.raises(ConfigError, match="is not an identifier"):
        task(name, size=lambda: 0.0)


def test_two_functions_cannot_share_a_name() -> None:
    """The second function with the same name is refused."""
    with pytest.raises(ConfigError, match="registered twice"):

        @task("double", size=abs)
        def other(number: float) -> float:
            return number


def test_unknown_tasks_are_named() -> None:
    """The error lists the known names, or says that the decorator is missing."""
    with pytest.raises(UnknownTask, match=r"no task named 'dubble'; known: .*double"):
        kind_named("dubble")
    with pytest.raises(UnknownTask, match="decorate it with @task"):
        kind_of(len)


@pytest.mark.parametrize(
    ("name", "why"), [("no_such_module", "ModuleNotFound"), ("", "ValueError"), ("sick", "1 / 0")]
)
def test_a_module_that_cannot_be_imported_is_named(
    name: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names the module and the reason: a typo, an empty name, or an exception in the module."""
    (tmp_path / "sick.py").write_text("raise RuntimeError('1 / 0')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=f"task module '{name}' cannot be imported: .*{why}"):
        load_modules([name])


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("myorb.py", "myorb"),
        ("./myorb", "myorb"),
        ("./vision/myorb.py", "vision.myorb"),
        ("../myorb.py", "myorb"),
        ("/home/robot/myorb.py", "myorb"),
        ("myorb:detect", "myorb"),
        ("myorb.py:detect", "myorb"),
    ],
)
def test_a_file_or_a_function_is_not_taken_for_a_module(name: str, meant: str) -> None:
    """The error says which module was probably meant."""
    with pytest.raises(ConfigError) as caught:
        load_modules([name])
    assert str(caught.value) == (f"task module {name!r} is not the name of a module; did you mean {meant!r}?")


@pytest.mark.parametrize(
    ("name", "end"),
    [
        ("no_such_module", "it is looked for in this folder and on PYTHONPATH"),
        ("no_such_folder.module", "it is looked for in this folder and on PYTHONPATH"),
        (
            "examples.no_such",
            "examples/ is only in a checkout: start the command in the folder of the checkout",
        ),
        ("needy", "No module named 'no_such_library'"),
    ],
)
def test_the_places_of_modules_are_named(
    name: str, end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the module was not found, the error says where it was looked for; not if a library is missing."""
    (tmp_path / "needy.py").write_text("import no_such_library")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as caught:
        load_modules([name])
    assert str(caught.value).endswith(end)


def test_a_keyword_only_parameter_is_refused() -> None:
    """Arguments are sent by position, so its value would be lost."""
    with pytest.raises(ConfigError, match="'scale' is keyword-only; make it positional"):

        @task("scaled", size=abs)
        def scaled(number: float, *, scale: float = 1.0) -> float:
            return number * scale
