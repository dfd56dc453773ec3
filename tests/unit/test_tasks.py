"""Registering tasks and finding them again."""

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
    """Keywords and defaults end up as positional arguments."""
    assert kind_of(double).bind((3,), {"scale": 2}) == (3, 2)
    assert kind_of(double).bind((3,), {}) == (3, 1)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
def test_a_size_that_is_no_finite_number_is_refused(bad: float) -> None:
    """The input size d is finite and not negative."""
    with pytest.raises(BadValue, match="task double: input size"):
        kind_of(double).size_of((bad, 1))


def test_the_source_hash_follows_the_source() -> None:
    """Equal source has an equal hash, a changed body another."""

    def register(name: str, body: str) -> str:
        space: dict[str, object] = {}
        exec(body, {"task": task}, space)
        return kind_named(name).source_hash

    # Source made by exec cannot be read back: no hash, which equals no other.
    assert register("made_up", "@task('made_up', size=abs)\ndef made_up(x): return x") == ""
    assert len(kind_of(double).source_hash) == 64


@pytest.mark.parametrize("name", ["", "a b", "x" * 65, "1st", "../x", "a\nb"])
def test_a_bad_name_is_refused(name: str) -> None:
    """Names are identifiers of bounded length: they appear in logs, metrics and on the wire."""
    with pytest.raises(ConfigError, match="is not an identifier"):
        task(name, size=lambda: 0.0)


def test_two_functions_cannot_share_a_name() -> None:
    """Registering another function under a known name is refused."""
    with pytest.raises(ConfigError, match="registered twice"):

        @task("double", size=abs)
        def other(number: float) -> float:
            return number


def test_unknown_names_list_the_known() -> None:
    """Both look-ups say what to do."""
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
    """--tasks with a typo, an empty name or a module that fails says which module and why."""
    (tmp_path / "sick.py").write_text("raise RuntimeError('1 / 0')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=f"task module '{name}' cannot be imported: .*{why}"):
        load_modules([name])


def test_a_parameter_that_goes_by_keyword_only_is_refused() -> None:
    """Calls cross the wire as positions; a keyword-only parameter would be lost on the way."""
    with pytest.raises(ConfigError, match="'scale' can only be given by keyword"):

        @task("scaled", size=abs)
        def scaled(number: float, *, scale: float = 1.0) -> float:
            return number * scale
