"""Tests of `examples/`: inputs, sizes, answers that can be sent, and the message about a missing library."""

import importlib
import itertools
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from offboard import MissingExtra
from offboard.common.tasks import Kind, kinds
from offboard.common.wire.values import decode, encode
from tests.extras import needs

ROOT = Path(__file__).parents[2]
CALLS = 2
# The module, its extra, the library that it imports, and arguments of `inputs` that keep the calls short.
APPLICATIONS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "apriltags": ("apriltags", "pupil_apriltags", {"shapes": ((480, 640),)}),
    "registration": ("registration", "small_gicp", {"points": (2_000, 4_000)}),
    "signs": ("signs", "rapidocr", {"shape": (240, 320)}),
    "pose_graph": ("pose-graph", "gtsam", {"poses": (100, 250), "calls": 3}),
    "arm": ("arm", "pyroboplan", {}),
}

pytestmark = [
    # These libraries warn about themselves and about newer versions of others.
    pytest.mark.filterwarnings("default::DeprecationWarning", "default::SyntaxWarning"),
]


class Application:
    """An example, the kind that it registers, and the result of the kind's setup."""

    def __init__(self, name: str) -> None:
        extra, library, self.short = APPLICATIONS[name]
        pytest.importorskip(library, reason=f"needs the extra '{extra}': pip install '.[{extra}]'")
        self.module: ModuleType = importlib.import_module(f"examples.{name}")
        self.kind: Kind = next(one for one in kinds() if one.function.__module__ == self.module.__name__)
        self.engine = () if self.kind.setup is None else (self.kind.setup(),)

    def calls(self, seed: int) -> list[tuple[Any, ...]]:
        return list(itertools.islice(self.module.inputs(seed, **self.short), CALLS))

    def run(self, args: tuple[Any, ...]) -> Any:
        return self.kind.function(*self.engine, *args)


@pytest.fixture(scope="module", params=APPLICATIONS)
def application(request: pytest.FixtureRequest) -> Application:
    return Application(request.param)


def test_a_seed_draws_the_same_inputs(application: Application) -> None:
    """The same seed draws the same arguments, and another seed draws other ones."""
    first, again, other = (application.calls(seed) for seed in (1, 1, 2))
    assert len(first) == CALLS
    assert equal(first, again)
    assert not equal(first, other)


def test_sizes_are_finite(application: Application) -> None:
    """The size of every call is a finite number above 0."""
    for args in application.calls(3):
        size = application.kind.size_of(args)
        assert math.isfinite(size)
        assert size > 0


def test_two_runs_agree(application: Application) -> None:
    """A second run gives the same answer, and the answer to another call is not the same."""
    one, other = application.calls(4)
    answer = application.run(one)
    assert application.module.same(answer, application.run(one))
    assert not application.module.same(answer, application.run(other))


def test_the_answer_survives_the_wire(application: Application) -> None:
    """Arguments that were sent give an answer that can be sent, and that is still the same."""
    kind, (args, _) = application.kind, application.calls(5)
    answer = application.run(args)
    arrived = tuple(carried(list(args), kind))
    assert application.module.same(answer, application.run(arrived))
    assert application.module.same(answer, carried(answer, kind))


@pytest.mark.parametrize("name", [name for name in APPLICATIONS if name != "apriltags"])  # it reports none
def test_work_is_above_zero(name: str) -> None:
    """A kind that reports work reports a number above 0."""
    application = Application(name)
    work = application.kind.work_of(application.run(application.calls(6)[0]))
    assert work is not None
    assert work > 0


@pytest.mark.parametrize("name", APPLICATIONS)
def test_a_missing_library_names_the_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its library an example cannot be imported, and the message says what to install."""
    extra, library, _ = APPLICATIONS[name]
    for known in [one for one in sys.modules if one.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, known)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"examples.{name}", raising=False)
    with pytest.raises(MissingExtra, match=rf"run pip install '\.\[{extra}\]'"):
        importlib.import_module(f"examples.{name}")


def program(name: str, *words: str, absent: str = "") -> "subprocess.CompletedProcess[str]":
    """`python -m examples.NAME WORD ...` where the library `absent` is not installed."""
    probe = (
        "import runpy, sys\n"
        f"sys.modules[{absent!r}] = None\n"
        f"sys.argv = {[name, *words]!r}\n"
        f"runpy.run_module('examples.{name}', run_name='__main__', alter_sys=True)\n"
    )
    return subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=30, cwd=ROOT)


@pytest.mark.parametrize("name", APPLICATIONS)
def test_a_program_without_its_library_says_what_to_install(name: str) -> None:
    """It ends with one line and exit code 2; so does the measurement of this example."""
    extra, library, _ = APPLICATIONS[name]
    said = f"{needs(f'examples.{name}', extra)}\n"
    done = program(name, "tcp://127.0.0.1:5555", absent=library)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)
    done = program("measure", name, absent=library)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"examples.measure: {said}")


def test_a_wrong_command_line_is_one_line() -> None:
    """A program without a server, with a wrong one, or with an unknown example says so, with exit code 2."""
    pytest.importorskip("small_gicp", reason="needs the extra 'registration'")
    needed = "one argument is needed: tcp://HOST:PORT of the server"
    wrong = "cloud: 'localhost' is not tcp://HOST:PORT"
    known = "'lidar' is not one of apriltags, registration, signs, pose_graph, arm"
    for name, words, said in (
        ("registration", (), needed),
        ("registration", ("tcp://127.0.0.1:5555", "more"), needed),
        ("registration", ("localhost",), wrong),
        ("measure", ("lidar",), known),
    ):
        done = program(name, *words)
        assert done.returncode == 2
        assert done.stderr.startswith(f"examples.{name}: {said}"), done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("name", APPLICATIONS)
def test_an_example_can_be_read_at_once(name: str) -> None:
    """An example has at most 140 lines."""
    lines = ROOT.joinpath("examples", f"{name}.py").read_text().splitlines()
    assert 60 <= len(lines) <= 140


def carried(value: Any, kind: Kind) -> Any:
    """The value as it arrives at the other side."""
    return decode(encode(value, kind.types).frames, kind.types, {})


def equal(a: Any, b: Any) -> bool:
    """Whether nested lists, tuples and arrays hold the same values."""
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return bool(np.array_equal(a, b))
