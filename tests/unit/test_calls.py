"""Calls of a task with inputs: the arguments of each call, and the errors of a generator of inputs."""

import itertools
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.loadgen.robot import answers
from offboard.loadgen.robot.calls import Calls, make_calls
from offboard.loadgen.robot.config import CallConfig
from offboard.loadgen.robot.run import LARGE_MADE_MAX, OwnRecord, Run
from offboard.robot_client.sites.onboard import OnboardRunner
from tests import frames
from tests.extras import needs
from tests.probes import swallow
from tests.scripted import offloader


def calls(inputs: str, task: str = "brightness", **settings: Any) -> Calls:
    return make_calls(CallConfig(task=f"tests.frames:{task}", inputs=f"tests.frames:{inputs}", **settings))


def drawn(work: Calls, count: int) -> list[tuple[Any, ...]]:
    """The arguments of the next calls."""
    found = []
    for _ in range(count):
        found.append(work.request())
        work.advance(None)
    return found


def test_an_input_is_a_tuple_of_arguments_or_the_only_one() -> None:
    """A frame becomes the only argument; a tuple holds all arguments; a second request returns the same."""
    work = calls("frames")
    assert work.request()[0] is work.request()[0]
    ((frame,),) = drawn(work, 1)
    assert frame.shape == frames.SHAPE
    assert [gain for _, gain in drawn(calls("with_gain"), 3)] == [1.0, 2.0, 3.0]


def test_the_seed_decides_the_inputs() -> None:
    """The function gets --seed; a call that is left out takes its input with it."""
    first = drawn(calls("frames", seed=3), 3)
    skipping = calls("frames", seed=3)
    skipping.advance(None)
    skipping.advance(None)
    assert np.array_equal(skipping.request()[0], first[2][0])
    assert not np.array_equal(drawn(calls("frames", seed=4), 1)[0][0], first[0][0])


@pytest.mark.parametrize(
    ("inputs", "error", "said"),
    [
        ("none", ConfigError, "is not MODULE:FUNCTION with a function of the seed: tests.frames has no"),
        ("no_seed", ConfigError, "is not MODULE:FUNCTION with a function of the seed: too many positional"),
        ("same", ConfigError, "is not MODULE:FUNCTION with a function of the seed: missing a required"),
        ("unfit", ConfigError, "input 1 does not fit task brightness: too many positional arguments"),
        ("with_gain", ConfigError, "gave 3 inputs, but --tasks and --alone need 200"),
        ("broken", OffloadError, "failed at input 2: OSError: no camera"),
    ],
)
def test_what_is_wrong_with_inputs_is_one_line(inputs: str, error: type[OffloadError], said: str) -> None:
    """A wrong use is a ConfigError; an exception of the function is an OffloadError with its cause."""
    with pytest.raises(error) as caught:
        drawn(calls(inputs, tasks=200), 4)
    assert type(caught.value) is error
    assert str(caught.value).startswith(f"--inputs: 'tests.frames:{inputs}'")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert error is ConfigError or isinstance(caught.value.__cause__, OSError)


@pytest.mark.parametrize("missing", ["task", "inputs"])
def test_a_missing_library_is_one_short_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    """A module that raises MissingExtra when it is imported names the extra, and nothing else."""
    raising = 'from offboard.common.errors import MissingExtra\nraise MissingExtra("tags", "apriltags")\n'
    (tmp_path / "needy_module.py").write_text(raising)
    monkeypatch.syspath_prepend(tmp_path)
    named = {"task": "tests.frames:brightness", "inputs": "tests.frames:frames"}
    with pytest.raises(ConfigError) as caught:
        make_calls(CallConfig(**named | {missing: "needy_module:f"}))  # type: ignore[arg-type]
    assert str(caught.value) == needs("tags", "apriltags")


def test_exactly_as_many_inputs_as_tasks_are_enough() -> None:
    """The inputs may end with the last task."""
    assert len(drawn(calls("with_gain", tasks=3), 3)) == 3


@pytest.mark.parametrize("arrivals", [{}, {"arrivals": "constant", "rate": 500.0}], ids=["closed", "open"])
def test_without_a_number_of_tasks_the_inputs_decide(arrivals: dict[str, Any]) -> None:
    """If the inputs end, the run ends as if they were all; the summary says how many there were."""
    config = CallConfig(task="tests.frames:brightness", inputs="tests.frames:with_gain", **arrivals)
    own, said = OwnRecord(), list[str]()
    with offloader(OnboardRunner(), observers=[own]) as offload:
        Run(config, make_calls(config), offload, own=own, say=said.append).run()
    assert said[:2] == ["the inputs ended after 3 of 200 tasks", "3 tasks answered"]


def test_no_input_at_all_is_an_error() -> None:
    """Even if the number of tasks is not given, a function without inputs is a mistake."""
    with pytest.raises(ConfigError, match="gave 0 inputs, but --tasks and --alone need at least 1"):
        calls("nothing")


class Frame:
    """An argument that a weak reference can follow."""


@pytest.mark.parametrize("arrivals", [{}, {"arrivals": "constant", "rate": 500.0}], ids=["closed", "open"])
def test_few_inputs_are_in_memory_at_once(arrivals: dict[str, Any]) -> None:
    """Inputs are made as they are needed, and are let go after their task."""
    alive: weakref.WeakSet[Frame] = weakref.WeakSet()
    most = 0

    def given() -> Iterator[tuple[Frame]]:
        nonlocal most
        for _ in itertools.count():
            frame = Frame()
            alive.add(frame)
            most = max(most, len(alive))
            yield (frame,)
            del frame

    config = CallConfig(task="m:f", sizes=("constant:0",), tasks=60, in_flight=2, **arrivals)
    own = OwnRecord()
    with offloader(OnboardRunner(2), observers=[own]) as offload:
        work = Calls(swallow, given(), large=True)
        Run(config, work, offload, own=own, say=lambda _: None).run()
    print(most)
    assert most <= LARGE_MADE_MAX + 2 * config.in_flight + 4


def test_a_small_answer_is_kept_whole_where_answers_may_differ() -> None:
    """A module with `same` gets the bytes of small answers into the file, and they restore the answer."""
    work = calls("frames")
    answer = frames.brightness(*work.request())
    assert work.restore(work.describe(answer)) == answer
    large = calls("frames", task="copied")
    assert large.describe(frames.copied(*large.request())).keys() == {"sha256"}


def test_an_answer_that_cannot_be_restored_is_named() -> None:
    """Frames that are no value raise a DataError with the digest."""
    for torn in (["AAAA"], ["not base 64"], [1], []):
        with pytest.raises(DataError, match="answer 12ab: its frames cannot be read"):
            answers.value_of({"sha256": "12ab", "frames": torn}, ())


def test_inputs_and_sizes_exclude_each_other(tmp_path: Path) -> None:
    """A call needs one of the two."""
    with pytest.raises(ConfigError, match="--inputs: 'm:g' cannot be combined with --sizes"):
        CallConfig(task="m:f", sizes=("constant:1",), inputs="m:g", trace=tmp_path / "t")
    with pytest.raises(ConfigError, match="--task: 'm:f' needs --sizes or --inputs"):
        CallConfig(task="m:f")
