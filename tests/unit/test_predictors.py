"""The predictor contract for every predictor and every rival, and their registries."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError, MissingExtra
from offboard.loadgen import rivals
from offboard.robot_client import predictors
from offboard.robot_client.predictors import Predictor
from tests import checks
from tests.models import sized
from tests.table_loops import section

ROOT = Path(__file__).parents[2]
NAMES = rivals.PREDICTORS
WINDOWED = tuple(name for name in NAMES if name != predictors.PARTS)

# Limits of the error on a straight line, as a share of the error of the mean time.
GAINS = (
    dict.fromkeys(NAMES, 0.05)
    | {predictors.PARTS: 0.1, "random-forest": 0.2}
    | {"k-means": 0.2, "lstm": 0.3, "lstm-sequence": 0.3}
)
EXTRAS = {  # for each predictor, the library that it needs, and the extra that installs it
    "k-means": ("sklearn", "learned"),
    "random-forest": ("sklearn", "learned"),
    "arima": ("statsmodels", "learned"),
    "lstm": ("torch", "lstm"),
    "lstm-sequence": ("torch", "lstm"),
}
BASE = tuple(name for name in rivals.PREDICTORS if name not in EXTRAS)
HEAVY = ("sklearn", "statsmodels", "torch", "scipy", "pandas")


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    """Each predictor whose library is installed."""
    name: str = request.param
    try:
        rivals.make(name, checks.WINDOW)
    except MissingExtra as missing:
        pytest.skip(str(missing))
    return name


@pytest.fixture
def make(name: str) -> Callable[[], Predictor]:
    return lambda: sized(rivals.make(name, checks.WINDOW, seed=3))


@pytest.mark.parametrize("check", checks.CONTRACT, ids=lambda check: check.__name__)
def test_contract(check: Callable[[checks.Make], None], make: checks.Make) -> None:
    """Every check of the contract holds for every predictor."""
    check(make)


@pytest.mark.parametrize("name", WINDOWED, indirect=True)
@pytest.mark.parametrize("check", checks.WINDOWED, ids=lambda check: check.__name__)
def test_contract_of_a_window(check: Callable[[checks.Make], None], make: checks.Make) -> None:
    """Every check of the contract holds for every predictor that remembers a window."""
    check(make)


def test_a_line_is_learnt(name: str, make: checks.Make) -> None:
    """Every predictor uses the input size: on a line its error is far below that of the mean time."""
    checks.learns_a_line(make, GAINS[name])


def test_an_unknown_name_is_refused_with_all_names() -> None:
    """The error lists every name. A robot knows two; the test bench knows the rivals too."""
    for refuse, names in (
        (predictors.check_name, predictors.names()),
        (lambda name: predictors.make(name, 50), predictors.names()),
        (rivals.predictor, rivals.PREDICTORS),
        (lambda name: rivals.make(name, 50), rivals.PREDICTORS),
    ):
        for unknown in ("k-mean", "river:linear_model.LinearRegression"):
            with pytest.raises(ConfigError) as refused:
                refuse(unknown)
            for part in (f"{unknown!r} is not one of ", *names, "or MODULE.CLASS of your own"):
                assert part in str(refused.value)


def test_the_evaluation_page_lists_every_name() -> None:
    """Its table has a line for every predictor."""
    table = section("Predictors")
    for listed in rivals.PREDICTORS:
        assert f"`{listed}`" in table, listed


def test_a_robot_knows_a_rival_by_its_path(name: str) -> None:
    """What `loadgen` passes to a robot is a name of the robot, and makes the same predictor."""
    known = rivals.predictor(name)
    predictors.check_name(known)
    assert type(predictors.make(known, 50)) is type(rivals.make(name, 50))


@pytest.mark.parametrize("name", WINDOWED, indirect=True)
@pytest.mark.parametrize("length", [0, 1, 10**9])
def test_a_window_out_of_bounds_is_refused(name: str, length: int) -> None:
    """No predictor accepts a window shorter than 2 or longer than its limit."""
    with pytest.raises(ConfigError, match=f"window {length}: "):
        rivals.make(name, length)


@pytest.mark.parametrize(("name", "library", "extra"), [(name, *needs) for name, needs in EXTRAS.items()])
def test_a_missing_library_names_its_extra(name: str, library: str, extra: str) -> None:
    """Without its library a predictor cannot be made, and one line names the extra to install."""
    said = python(
        "import sys\n"
        f"sys.modules[{library!r}] = None\n"
        "from offboard.common.errors import MissingExtra\n"
        "from offboard.loadgen import rivals\n"
        "try:\n"
        f"    rivals.make({name!r}, 50)\n"
        "except MissingExtra as missing:\n"
        "    print(missing)\n"
    )
    assert said.endswith(
        f"needs the extra '{extra}': run pip install '.[{extra}]' in a checkout of Offboard\n"
    ), said
    assert said.count("\n") == 1


def test_the_base_predictors_load_no_heavy_library() -> None:
    """Predictors that need no extra work with numpy only."""
    said = python(
        "import sys\n"
        "from offboard.loadgen import rivals\n"
        "from offboard.robot_client.predictors.base import Call, Run\n"
        "from offboard.robot_client.predictors.plain import model_of\n"
        f"for name in {BASE!r}:\n"
        "    model = model_of(rivals.make(name, 5), remote=True)\n"
        "    for i in range(6):\n"
        "        model.learn(Call(i), Run(i * i))\n"
        "    assert model.predict(Call(3.0))\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    assert said == "[]\n"


def python(code: str) -> str:
    """What the code prints, run in a new process."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.returncode == 0, done.stderr
    return done.stdout
