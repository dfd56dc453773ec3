"""Broken parts, with which the checks of a scenario must fail; `fails_with` of a check names one.

Run as a program, this is a planning server that gives wrong answers, or leaks memory and files.
"""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.source.task_modules import load_modules
from offboard.common.tasks import Kind, kinds
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.testbed.local_testbed import COMMANDS, LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, Setup

LEAK_BYTES = 300_000

_kept: list[Any] = []


def dead_robot(scenario: Scenario) -> Scenario:
    """The scenario with a robot that is killed half-way and not started again."""
    death = Event("kill", ROBOT, at_task=scenario.workload.tasks // 2)
    return replace(scenario, events=(*scenario.events, death))


def always_cloud(scenario: Scenario) -> Scenario:
    """The scenario with a robot that uses the answers of the server, even if it is the slower site."""
    return scenario.changed(policy="cloud")


def unchanged(scenario: Scenario) -> Scenario:
    return scenario


def bed_with(cloud: str | None) -> Callable[[Path, Mapping[str, Setup]], LocalTestbed]:
    """Makes local testbeds with one of the broken servers below, or with the real server."""
    commands = dict(COMMANDS)
    if cloud is not None:
        commands[CLOUD] = (sys.executable, "-m", "tests.breaks", cloud)
    return lambda out, setups: LocalTestbed(out, setups, commands=commands)


BREAKS: dict[str, tuple[Callable[[Scenario], Scenario], str | None]] = {
    "dead-robot": (dead_robot, None),
    "lying-cloud": (always_cloud, "lie"),
    "leaky-cloud": (unchanged, "leak"),
}


def lie(answer: Any) -> Any:
    """A wrong answer of the right type: reversed bytes and arrays, or a list without its first item."""
    if isinstance(answer, bytes):
        return answer[::-1]
    if isinstance(answer, list):
        return answer[1:]
    values = {field.name: getattr(answer, field.name) for field in fields(answer)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    return replace(answer, **{name: value[::-1].copy() for name, value in arrays.items()})


def leak(answer: Any) -> Any:
    """The right answer; each call leaks memory and an open file."""
    _kept.append((bytearray(b"x" * LEAK_BYTES), os.open(os.devnull, os.O_RDONLY)))
    return answer


def _break(kind: Kind, how: Callable[[Any], Any]) -> None:
    function = kind.function
    object.__setattr__(kind, "function", lambda *args: how(function(*args)))


if __name__ == "__main__":
    from offboard.cloud_server.__main__ import main

    how, *flags = sys.argv[1:]
    modules = next(flag for flag in flags if flag.startswith("--tasks=")).removeprefix("--tasks=")
    load_modules(modules.split(","))
    for one in kinds():
        _break(one, {"lie": lie, "leak": leak}[how])
    # Threads use the broken tasks of this process; worker processes would load the right ones.
    sys.argv[1:] = [flag for flag in flags if not flag.startswith("--executor=")]
    sys.exit(main())
