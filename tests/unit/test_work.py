"""The two kinds of work: plans for a robot on a map, and calls of a function with a size."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.common.planning import PLANNERS
from offboard.common.planning.planner import Plan, plan_path, size_of_plan
from offboard.loadgen.robot.answers import cells_of
from offboard.loadgen.robot.config import CallConfig, DriveConfig
from offboard.loadgen.robot.work import Work, make_work
from offboard.loadgen.scenario.hash_tasks import MUCH, RARE, hash_rarely_long, hash_rounds, rounds_on
from offboard.loadgen.testbed.testbed import PART
from tests import probes
from tests.mazes import warm

DEPOT = Path(__file__).parents[2] / "maps/depot.yaml"
NO_PATH = Plan("NO_VALID_PATH", np.zeros((0, 2), np.int32), np.zeros((0, 2), np.float32), 0.0, 0)
warm()  # compiles before the clock of any test runs


def on_map(*sizes: str, seed: int = 3, jump: bool = True) -> Work:
    return make_work(DriveConfig(map=DEPOT, resolution=0.05, seed=seed, jump=jump, sizes=sizes))


def calls(*sizes: str, task: str = "tests.probes:zeros", **settings: Any) -> Work:
    return make_work(CallConfig(task=task, sizes=sizes, **settings))


def asked(work: Work, answers: Sequence[Any]) -> list[Any]:
    """The requests that these answers lead to, as plain values."""
    found = []
    for answer in answers:
        _, scan, pose, goal, radius, *_ = work.request()
        found.append((scan.ranges.tolist(), pose, goal, radius))
        work.advance(answer)
    return found


@pytest.mark.parametrize("sizes", [(), ("uniform:0:3",)])
def test_with_jumps_answers_do_not_change_later_requests(sizes: tuple[str, ...]) -> None:
    """The tasks of a seed are the same if they are answered, failed or not asked; seeds differ."""
    first = asked(on_map(*sizes), [None] * 8)
    assert first == asked(on_map(*sizes), [NO_PATH] * 8)
    work = on_map(*sizes)
    assert first == [asked(work, [plan_path(*work.request())])[0] for _ in range(8)]
    assert first != asked(on_map(*sizes, seed=4), [None] * 8)


MAP_YAML = """image: map.pgm
resolution: {resolution}
origin: [0, 0, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.2
"""


def small_map(folder: Path, resolution: float) -> Path:
    """An empty room of 90 x 60 cells, as a map.yaml."""
    rows = [bytes(90)] + [b"\0" + b"\xff" * 88 + b"\0"] * 58 + [bytes(90)]
    (folder / "map.pgm").write_bytes(b"P5\n90 60\n255\n" + b"".join(rows))
    path = folder / "map.yaml"
    path.write_text(MAP_YAML.format(resolution=resolution))
    return path


@pytest.mark.parametrize("resolution", [0.02, 0.03, 0.05])
def test_a_map_is_planned_at_its_own_resolution(tmp_path: Path, resolution: float) -> None:
    """Without --resolution, the cells are those of the map, and the robot finds its paths."""
    work = make_work(DriveConfig(map=small_map(tmp_path, resolution), obstacles=0, jump=True))
    for _ in range(5):
        grid, *_ = request = work.request()
        assert (grid.resolution, grid.cells.shape) == (resolution, (60, 90))
        assert plan_path(*request).status == "NONE"
        work.advance(None)


def test_a_resolution_must_divide_that_of_the_map(tmp_path: Path) -> None:
    """0.03 m can be planned at 0.015 m; 0.025 m is refused."""
    path = small_map(tmp_path, 0.03)
    assert make_work(DriveConfig(map=path, obstacles=0, resolution=0.015)).request()[0].resolution == 0.015
    with pytest.raises(DataError, match=r"resolution 0\.025"):
        make_work(DriveConfig(map=path, obstacles=0, resolution=0.025))


@pytest.mark.parametrize("name", PLANNERS)
def test_requests_name_the_planner_of_the_flag(name: str) -> None:
    """Each planner is named in the request, and its path has the same cost."""
    config = DriveConfig(map=DEPOT, resolution=0.05, seed=3, planner=name)
    first, request = on_map().request(), make_work(config).request()
    assert request[-1] == name
    assert plan_path(*request).cost == plan_path(*first).cost > 0


def test_without_jumps_the_robot_drives_its_answers() -> None:
    """The robot moves along the plan, and picks another goal if there was no answer."""
    work = on_map(jump=False)
    _, _, pose, goal, *_ = request = work.request()
    work.advance(plan_path(*request))
    assert work.request()[2] != pose
    pose, goal = work.request()[2:4]
    work.advance(None)
    assert work.request()[2] == pose
    assert work.request()[3] != goal


def test_goals_follow_the_sizes() -> None:
    """Goals are near for small sizes, and far for large sizes from task 5 on."""
    work = on_map("constant:0.02", "5=constant:2")
    found = []
    for _ in range(10):
        found.append(size_of_plan(*work.request()))
        work.advance(None)
    print(found)
    assert max(found[:5]) < 0.2 < 0.8 < min(found[5:])


def test_calls_get_whole_sizes() -> None:
    """Each call gets int() of its size; neither a second request nor an answer changes it."""
    work = calls("constant:2.9", "2=constant:7")
    assert work.function is probes.zeros
    found = []
    for answer in (None, 1, "two"):
        assert work.request() == work.request()
        found.append(work.request())
        work.advance(answer)
    assert found == [(2,), (2,), (7,)]
    assert all(type(size) is int for (size,) in found)


def test_a_task_with_a_setup_is_called_with_its_size_alone() -> None:
    """Its first parameter is not for callers, so `loadgen call` takes it as a task of one number."""
    assert calls("constant:2", task="tests.stateful_tasks:engine_twice").request() == (2,)


def test_the_seed_decides_the_calls() -> None:
    """One seed always gives the same sizes, and seeds differ."""

    def story(seed: int) -> list[Any]:
        work = calls("lognormal:1000:1", seed=seed)
        found = []
        for _ in range(20):
            found.append(work.request())
            work.advance(None)
        return found

    assert story(1) == story(1) != story(2)


def test_answers_are_described_for_the_file() -> None:
    """A plan is described by its path, also if it has none; any other answer by its digest."""
    work = on_map()
    plan = plan_path(*work.request())
    assert cells_of(work.describe(plan)).tolist() == plan.cells.tolist()
    assert work.got(plan)
    assert not work.got(NO_PATH)
    assert work.describe(NO_PATH)["status"] == "NO_VALID_PATH"
    assert list(calls("constant:1").describe(probes.zeros(3))) == ["sha256"]


@pytest.mark.parametrize(
    ("task", "why"),
    [
        ("tests.probes", "one of the two is missing"),
        (":zeros", "one of the two is missing"),
        ("tests.probes:", "one of the two is missing"),
        ("no_such_module:f", "cannot be imported: ModuleNotFoundError"),
        ("tests.probes:ones", "tests.probes has no function 'ones'"),
        ("tests.probes:np", "tests.probes has no function 'np'"),
        ("math:sqrt", "sqrt is not a task; decorate it with @task"),
        ("tests.probes:process_id", "too many positional arguments"),
        ("offboard.common.planning.planner:plan_path", "missing a required argument"),
    ],
)
def test_a_task_that_cannot_be_called_is_refused(task: str, why: str) -> None:
    """The error is one line with the value of --task, what is allowed, and the reason."""
    with pytest.raises(ConfigError) as caught:
        calls("constant:1", task=task)
    said = str(caught.value)
    assert said.startswith(f"--task: {task!r} is not MODULE:FUNCTION with a @task function of one number: ")
    assert why in said
    assert "\n" not in said


@pytest.mark.parametrize("flag", ["measure", "alone", "reference"])
def test_a_task_that_must_not_run_twice_is_not_measured(flag: str) -> None:
    """A task declared duplicate=False is refused with a flag that would run it again."""
    settings: dict[str, Any] = {flag: 2, "cloud": "tcp://h:1", "trace": Path("t")}
    with pytest.raises(ConfigError, match=f"--{flag}: 2: task mark_once is declared duplicate=False"):
        calls("constant:1", task="tests.probes:mark_once", **settings)


def test_a_missing_file_of_sizes_is_named() -> None:
    """The error is raised before the robot is made."""
    with pytest.raises(DataError, match=r"--sizes: 'none\.csv' is not"):
        on_map("none.csv")


def test_a_rare_task_takes_long_on_one_part_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """One size in RARE takes MUCH times the rounds, on each part another size; answers do not change."""
    for part in ("cloud", "robot"):
        rare = sum(rounds_on(part, rounds) == MUCH * rounds for rounds in range(1, 25_001))
        assert rare == pytest.approx(25_000 / RARE, rel=0.1)
    both = sum(rounds_on("cloud", n) == rounds_on("robot", n) == MUCH * n for n in range(1, 25_001))
    assert both < 100
    long_here = next(n for n in range(1, 1_000) if rounds_on("robot", n) > n and rounds_on("cloud", n) == n)
    answers = set()
    for part in ("cloud", "robot"):
        monkeypatch.setenv(PART, part)
        answers.add(hash_rarely_long(long_here))
    assert answers == {hash_rounds(long_here)}
