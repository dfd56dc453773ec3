"""Registering tasks and finding them."""

import importlib
import linecache
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import BadValue, ConfigError, UnknownTask
from offboard.common.source.task_modules import load_modules
from offboard.common.tasks import kind_named, kind_of, task

ROOT = Path(__file__).parents[2]


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
    """It has 64 characters."""
    assert len(kind_of(double).source_hash) == 64


def test_code_made_by_exec_has_no_source_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its source cannot be read, although Python 3.13 keeps the source of `python -c` under its file name."""
    lines = ["import offboard\n"] * 3
    monkeypatch.setitem(linecache.cache, "<string>", (sum(map(len, lines)), None, lines, "<string>"))
    exec("@task('made_up', size=abs)\ndef made_up(x): return x", {"task": task})
    assert kind_named("made_up").source_hash == ""


@pytest.mark.parametrize("name", ["", "a b", "x" * 65, "1st", "../x", "a\nb", 5, None, b"x"])
def test_a_bad_name_is_refused(name: Any) -> None:
    """Names are short identifiers, because they appear in logs, metrics and messages."""
    with pytest.raises(ConfigError, match="is not an identifier"):
        task(name, size=lambda: 0.0)


def test_two_functions_cannot_share_a_name() -> None:
    """The second function with the same name is refused."""
    with pytest.raises(ConfigError, match="registered twice"):

        @task("double", size=abs)
        def other(number: float) -> float:
            return number


TWIN = """from offboard.common.tasks import task


def times(number):
    return {factor} * number


@task("twin", size=float)
def twin(number):
    return times(number)
"""


def test_a_name_of_two_modules_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the source of both functions is the same: what they call may differ."""
    for name, factor in (("twin_a", 2), ("twin_b", 3)):
        (tmp_path / f"{name}.py").write_text(TWIN.format(factor=factor))
    monkeypatch.syspath_prepend(tmp_path)
    first = importlib.import_module("twin_a")
    said = "task twin is registered twice, by twin_a.twin and by twin_b.twin; rename one of them"
    with pytest.raises(ConfigError, match=said):
        importlib.import_module("twin_b")
    assert kind_named("twin").function is first.twin
    again = importlib.reload(first)
    assert kind_named("twin").function is again.twin


def test_a_module_that_is_also_the_script_registers_its_tasks_twice(tmp_path: Path) -> None:
    """It is the same file, so each name means the same function."""
    main = "\nif __name__ == '__main__':\n    import script\n    print(script.twin(4), twin(5))\n"
    (tmp_path / "script.py").write_text(TWIN.format(factor=2) + main)
    done = subprocess.run(
        [sys.executable, "script.py"],
        capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("8 10\n", "")


class Engine:
    factor = 2


class OtherEngine:
    factor = 3


def test_the_source_hash_covers_the_setup() -> None:
    """Robot and server compare what `setup` makes, not only the function."""

    def run_engine(engine: Any, number: float) -> float:
        return float(engine.factor * number)

    hashes = []
    for name, setup in (("engine_a", Engine), ("engine_b", OtherEngine), ("engine_c", Engine)):
        task(name, size=float, setup=setup)(run_engine)
        hashes.append(kind_named(name).source_hash)
    assert hashes[0] == hashes[2] != hashes[1]


PACKED = """from offboard.common.tasks import task


def to_link(number):
    return {to}


def from_link(value):
    return {back}


@task("{name}", size=float, pack=to_link, unpack=from_link)
def twice(number):
    return 2 * number
"""


def test_the_source_hash_covers_pack_and_unpack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that unpacks in another way than the robot packs is noticed when they connect."""
    monkeypatch.syspath_prepend(tmp_path)
    sources = {"same_a": ("number", "value"), "same_b": ("number", "value")}
    sources |= {"other_pack": ("number + 1", "value"), "other_unpack": ("number", "value - 1")}
    hashes = {}
    for module, (to, back) in sources.items():
        text = PACKED.format(name="packed_twice", to=to, back=back)
        (tmp_path / f"{module}.py").write_text(text)
        code = (
            "import sys; from offboard.common import tasks; from offboard.common.source import task_modules; "
        )
        code += "task_modules.load_modules(sys.argv[1:]); print(tasks.kind_named('packed_twice').source_hash)"
        done = subprocess.run(
            [sys.executable, "-c", code, module],
            capture_output=True, text=True, check=True, env={"PYTHONPATH": f"{ROOT}:{tmp_path}"},
        )  # fmt: skip
        hashes[module] = done.stdout
    assert hashes["same_a"] == hashes["same_b"]
    assert len(set(hashes.values())) == 3


@pytest.mark.parametrize(
    ("packing", "said"),
    [
        ({"pack": bytes}, "pack= and unpack= need each other; give both or none"),
        ({"unpack": bytes}, "pack= and unpack= need each other; give both or none"),
        ({"pack": "jpeg", "unpack": bytes}, "pack= is 'jpeg'; it must be a function"),
        ({"pack": bytes, "unpack": 90}, "unpack= is 90; it must be a function"),
    ],
)
def test_wrong_packing_is_refused(packing: dict[str, Any], said: str) -> None:
    """One line names the task, the keyword and what is allowed."""
    with pytest.raises(ConfigError) as caught:
        task("half_packed", size=float, **packing)(double)
    assert str(caught.value) == f"task half_packed: {said}"


def test_a_tuple_holds_all_arguments_of_a_function_that_takes_several() -> None:
    """For a function of one argument, a tuple is that argument."""

    def one(first: Any) -> None: ...
    def many(*all_of_them: Any) -> None: ...

    task("arguments_one", size=lambda _: 0)(one)
    task("arguments_many", size=lambda *_: 0)(many)
    assert kind_named("arguments_one").arguments_in((1, 2)) == ((1, 2),)
    assert kind_named("arguments_many").arguments_in((1, 2)) == (1, 2)
    assert kind_of(double).arguments_in((1, 2)) == (1, 2)
    assert kind_of(double).arguments_in([1, 2]) == ([1, 2],)


@pytest.mark.parametrize("name", ["timeout_s", "where", "observe", "deadline_s", "function"])
def test_a_parameter_cannot_have_the_name_of_an_option(name: str) -> None:
    """The call would take its value for the option. The first parameter of a task with a setup may."""
    code: dict[str, Any] = {}
    exec(f"def alone({name}): ...\ndef second(number, {name}=1): ...\ndef many(*{name}): ...", code)
    said = f"task optional: a parameter cannot be named {name!r}, an option of the call; rename it"
    for function in (code["alone"], code["second"], code["many"]):
        with pytest.raises(ConfigError) as caught:
            task("optional", size=float)(function)
        assert str(caught.value) == said
    task(f"state_{name}", size=float, setup=dict)(code["alone"])


async def later(number: float) -> float:
    return number


def one_by_one(number: float) -> Iterator[float]:
    yield number


async def later_one_by_one(number: float) -> AsyncIterator[float]:
    yield number


@pytest.mark.parametrize("function", [later, one_by_one, later_one_by_one, partial(later, 1.0)])
@pytest.mark.parametrize("place", ["function", "size", "setup", "work", "warm", "pack", "unpack"])
def test_coroutine_and_generator_functions_are_refused(place: str, function: Callable[..., Any]) -> None:
    """Calling one computes nothing, so every function of a task must be an ordinary one."""
    given: dict[str, Any] = {"function": double, "size": float, place: function}
    with pytest.raises(ConfigError, match=f"task lazy: {place} .* is a coroutine or generator function; "):
        task("lazy", **{key: value for key, value in given.items() if key != "function"})(given["function"])


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
