"""Calls of a `@task` function: finds the function, and makes the arguments of each call from sizes or inputs.

When they are asked for is up to `run`; where they run is up to the offloader.
"""

import inspect
import sys
from collections.abc import Callable, Iterator
from typing import Any

from offboard.common.errors import BadValue, ConfigError, MissingExtra, OffloadError, describe, of_task
from offboard.common.source.task_modules import load_modules
from offboard.common.tasks import Kind, kind_of
from offboard.loadgen.robot import answers
from offboard.loadgen.robot.config import CallConfig
from offboard.loadgen.robot.workload import parse_sizes, sizes
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

NAMED = "MODULE:FUNCTION"
SAME = "same"  # function of a task's module: whether two answers are equal within its tolerance

Arguments = tuple[Any, ...]


class InputsEnded(Exception):
    """All inputs were used, and the settings do not say how many tasks there must be."""


class Calls:
    """Calls of a `@task` function with the `arguments`, of which each is made when it is needed.

    `large` arguments may be megabytes each, so that few of them are held in memory.
    """

    noun = "tasks"
    found: str | None = None
    independent = True

    def __init__(
        self, function: Callable[..., Any], arguments: Iterator[Arguments], *, large: bool = False
    ) -> None:
        self.function = function
        self.large = large
        self.same: Callable[[Any, Any], bool] | None = getattr(
            sys.modules.get(function.__module__), SAME, None
        )
        self._types = kind_of(function).types
        self._arguments = arguments
        self._present: Arguments | None = None

    def request(self) -> Arguments:
        if self._present is None:
            self._present = next(self._arguments)
        return self._present

    def advance(self, answer: Any) -> None:  # noqa: ARG002 - no call depends on an answer
        if self._present is None:
            next(self._arguments)
        self._present = None

    def got(self, answer: Any) -> bool:  # noqa: ARG002 - every answer counts
        return True

    def describe(self, answer: Any) -> dict[str, Any]:
        return answers.of_value(answer, self._types, whole=self.same is not None)

    def restore(self, described: dict[str, Any]) -> Any:
        """The answer that `describe` kept whole."""
        return answers.value_of(described, self._types)


def make_calls(config: CallConfig) -> Calls:
    """The calls that the settings ask for; a ConfigError or DataError if they cannot be made."""
    if config.own_stream:
        return _follow(config)
    what = f"{NAMED} with a @task function"
    if config.inputs is None:
        function = _find_task(config.task, f"{what} of one number")
        kind, flag = kind_of(function), f"--sizes: {','.join(config.sizes)!r}"
        _check_argument(config.task, kind)
        numbers = sizes(parse_sizes(config.sizes), config.seed)
        calls = Calls(function, ((int(size),) for size in numbers))
    else:
        function = _find_task(config.task, what)
        kind, flag = kind_of(function), f"--inputs: {config.inputs!r}"
        calls = Calls(function, _inputs(config, config.inputs, kind), large=True)
    _check_repeats(config, kind)
    try:
        kind.size_of(kind.bind(calls.request(), {}))
    except (BadValue, TypeError) as error:
        hint = "" if config.inputs else "; use --inputs for arguments that are no numbers"
        raise ConfigError(f"{flag}: {of_task(kind.name, str(error))}{hint}") from error
    return calls


def _follow(config: CallConfig) -> Calls:
    """The policy of `stream_policy`, with its observations."""
    from offboard.loadgen.robot.stream_policy import follow, observations

    assert config.stream_hz is not None
    run_s = {ONBOARD: 1e-3 * config.stream_onboard_ms, CLOUD: 1e-3 * config.stream_cloud_ms}
    seen = observations(config.stream_hz, config.stream_horizon, run_s, config.seed)
    return Calls(follow, ((one,) for one in seen))


def _find_task(name: str, allowed: str) -> Callable[..., Any]:
    try:
        function = _find(name)
        kind = kind_of(function)
    except MissingExtra:
        raise
    except OffloadError as error:
        raise ConfigError(f"--task: {name!r} is not {allowed}: {error}") from error
    return kind.function


def _check_argument(name: str, kind: Kind) -> None:
    """A ConfigError if the task does not take one argument."""
    try:
        kind.bind((0,), {})
    except TypeError as error:
        raise ConfigError(
            f"--task: {name!r} is not {NAMED} with a @task function of one number: {error}; "
            "use --inputs for other arguments"
        ) from error


def _inputs(config: CallConfig, name: str, kind: Kind) -> Iterator[Arguments]:
    """The arguments of each call, from the function of `--inputs`."""
    flag = f"--inputs: {name!r}"
    needed = None if config.tasks is None and not config.alone else config.tasks_max + config.alone
    try:
        function = _find(name)
        inspect.signature(function).bind(config.seed)
    except MissingExtra:
        raise
    except (OffloadError, TypeError, ValueError) as error:
        raise ConfigError(f"{flag} is not {NAMED} with a function of the seed: {error}") from error
    return _checked(_made(flag, function, config.seed), flag, kind, needed)


def _made(flag: str, function: Callable[[int], Any], seed: int) -> Iterator[Any]:
    """What the function of the user gives. Its exceptions are errors with their cause."""
    number = 0
    try:
        given = function(seed)
        if not hasattr(type(given), "__iter__"):
            raise ConfigError(f"{flag} returned {type(given).__name__}, which is not iterable")
        for one in given:
            yield one
            del one  # so that it is not kept while the next one is made
            number += 1
    except OffloadError:
        raise
    except Exception as error:
        raise OffloadError(f"{flag} failed at input {number}: {describe(error)}") from error


def _checked(given: Iterator[Any], flag: str, kind: Kind, needed: int | None) -> Iterator[Arguments]:
    """Each input as a tuple of arguments that the task takes. Without `needed`, one input is enough."""
    number = 0
    for one in given:
        arguments = one if isinstance(one, tuple) else (one,)
        del one
        try:
            kind.bind(arguments, {})
        except TypeError as error:
            raise ConfigError(f"{flag}: input {number} does not fit task {kind.name}: {error}") from error
        yield arguments
        del arguments
        number += 1
    if needed is None and number:
        raise InputsEnded
    raise ConfigError(f"{flag} gave {number} inputs, but --tasks and --alone need {needed or 'at least 1'}")


def _find(name: str) -> Callable[..., Any]:
    """The function that MODULE:FUNCTION names. A ConfigError says why there is none, or what to install."""
    module, _, function_name = name.partition(":")
    if not (module and function_name):
        raise ConfigError("one of the two is missing")
    try:
        load_modules([module])
    except ConfigError as error:
        if isinstance(error.__cause__, MissingExtra):  # its text says what to install
            raise error.__cause__ from None
        raise
    function = getattr(sys.modules[module], function_name, None)
    if not callable(function):
        raise ConfigError(f"{module} has no function {function_name!r}")
    found: Callable[..., Any] = function
    return found


def _check_repeats(config: CallConfig, kind: Kind) -> None:
    """A ConfigError if the settings run a task twice that must not run twice."""
    for flag in ("measure", "alone", "reference"):
        if getattr(config, flag) and not kind.duplicate:
            raise ConfigError(
                f"--{flag}: {getattr(config, flag)}: task {kind.name} is declared duplicate=False"
            )
