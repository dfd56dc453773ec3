"""Broken parts, for checks that must not hold with them; each is named in a scenario's `fails_with`.

As a program this is a planning server that answers wrongly, or keeps what it should let go.
"""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.tasks import Kind, kinds, load_modules
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.testbed.local_testbed import COMMANDS, LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, Setup

LEAK_BYTES = 300_000

_kept: list[Any] = []


def dead_robot(scenario: Scenario) -> Scenario:
    """The robot dies half way, and nobody starts it again."""
    death = Event("kill", ROBOT, at_task=scenario.workload.tasks // 2)
    return replace(scenario, events=(*scenario.events, death))


def unchanged(scenario: Scenario) -> Scenario:
    return scenario


def bed_with(cloud: str | None) -> Callable[[Path, Mapping[str, Setup]], LocalTestbed]:
    """A local testbed with one of the servers below, or with the real one."""
    commands = dict(COMMANDS)
    if cloud is not None:
        commands[CLOUD] = (sys.executable, "-m", "tests.breaks", cloud)
    return lambda out, setups: LocalTestbed(out, setups, commands=commands)


BREAKS: dict[str, tuple[Callable[[Scenario], Scenario], str | None]] = {
    "dead-robot": (dead_robot, None),
    "lying-cloud": (unchanged, "lie"),
    "leaky-cloud": (unchanged, "leak"),
}


def lie(answer: Any) -> Any:
    """An answer of the right kind that is wrong."""
    if isinstance(answer, bytes):
        return answer[::-1]
    return replace(answer, cells=answer.cells[::-1].copy(), metres=answer.metres[::-1].copy())


def leak(answer: Any) -> Any:
    """The right answer, and memory and a file that stay."""
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
    sys.argv[1:] = flags
    sys.exit(main())
