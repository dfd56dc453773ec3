"""Runs two applications behind a slow link: arguments as they are, packed by the task, and compressed.

Each task runs in the cloud, then onboard, so that both times and both answers can be compared.
"""

import contextlib
import importlib
import itertools
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks.measure import Requirement, Table
from offboard.common.command_line import CommandParser, add_flags, run_command
from offboard.common.config import check, resolve, setting
from offboard.common.errors import ConfigError, OffloadError
from offboard.common.task_states import TaskStates
from offboard.common.toml_file import unknown
from offboard.common.wire.compression import compressions
from offboard.common.wire.payload import payload_bytes
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.predictors import PARTS
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PROG = "python -m benchmarks.packing"
NAMES = ("signs", "registration")
RAW, PACKED, AUTOMATIC = "raw", "packed", "automatic"
WAYS = (RAW, PACKED, AUTOMATIC)
READY_S, TIMEOUT_S = 120.0, 30.0
LOSS_MAX = 1.05  # automatic compression takes at most this many times as long as no compression
COLUMNS = (
    "arguments",
    "choice",
    "kB before",
    "kB sent",
    "packing, ms",
    "cloud predicted, ms",
    "cloud true, ms",
    "error",
    "onboard true, ms",
    "predicted faster in the cloud",
    "truly faster in the cloud",
    "equal answers",
)


@dataclass(frozen=True)
class PackingConfig:
    """How much is measured, and the link."""

    tasks: int = setting(40, "tasks of each application and way", minimum=WARM_UP + 1, maximum=10_000)
    bandwidth_mbps: float = setting(
        20.0, "bandwidth of the link in each direction, in Mbit/s; 0 is unlimited", minimum=0.0, maximum=1e5
    )
    delay_ms: float = setting(15.0, "delay of the link in each direction, in ms", minimum=0.0, maximum=1e4)
    seed: int = setting(1, "seed of the inputs", minimum=0)
    out: Path = setting(Path("out/packing"), "folder for the traces and logs", metavar="DIR")

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class Measured:
    """One task: its bytes and times, predicted and true. `how` is empty if nothing was packed."""

    how: str
    raw_bytes: int
    sent_bytes: int
    pack_s: float
    predicted_s: float
    seconds: float
    predicted_onboard_s: float
    onboard_s: float
    equal: bool


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = CommandParser(prog=PROG, description=__doc__, operands="[NAME ...]")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"some of {', '.join(NAMES)} (default: both)"
    )
    add_flags(parser, PackingConfig, "PACKING")
    flags = parser.parse_args(argv)
    config = resolve(PackingConfig, flags, environ=os.environ, prefix="PACKING")
    names = tuple(dict.fromkeys(flags.names)) or NAMES
    for name in names:
        if name not in NAMES:
            raise ConfigError(unknown("application", name, NAMES))
    if not compressions():
        raise ConfigError("nothing can be compressed: this Python has no backports.zstd")
    for name in names:
        print(measure(name, config), flush=True)
    return 0


def measure(name: str, config: PackingConfig) -> Table:
    """Play one application in all ways, behind one link."""
    module = importlib.import_module(f"benchmarks.packed_{name}")
    cloud = {"tasks": module.__name__, "workers": 1, "executor": "processes"}
    link = {"bandwidth_mbps": config.bandwidth_mbps, "delay_ms": config.delay_ms}
    config.out.mkdir(parents=True, exist_ok=True)
    with LocalTestbed(config.out / name, {"cloud": Setup(cloud), "wan": Setup(link)}) as bed:
        bed.start()
        ways = play(module, bed.endpoint, config)
    title = f"{name}, {config.bandwidth_mbps:g} Mbit/s, {config.delay_ms:g} ms each way"
    pairs = zip(ways[AUTOMATIC], ways[RAW], strict=True)
    loss = statistics.median(automatic.seconds / raw.seconds for automatic, raw in pairs)
    needed = Requirement(f"{name}: true time of {AUTOMATIC}, relative to {RAW}", loss, LOSS_MAX)
    return Table(title, COLUMNS, [row(way, known) for way, known in ways.items()], [needed])


def play(module: ModuleType, endpoint: str, config: PackingConfig) -> dict[str, list[Measured]]:
    """The tasks of each way, without those of the warm-up.

    Each task runs in all ways before the next one, so that what else the computer does affects all of them.
    """
    found: dict[str, list[Measured]] = {way: [] for way in WAYS}
    states = TaskStates(workers=1)
    with contextlib.ExitStack() as opened:
        robots = {
            way: opened.enter_context(_robot(module, way, endpoint, config=config, states=states))
            for way in WAYS
        }
        for number, args in enumerate(itertools.islice(module.inputs(config.seed), config.tasks)):
            turn = number % len(WAYS)
            for way in (*WAYS[turn:], *WAYS[:turn]):
                one = _measured(robots[way], _function(module, way), args, module.same)
                if one is not None:
                    found[way].append(one)
    print(f"{module.__name__}: {config.tasks} tasks in each way", file=sys.stderr, flush=True)
    return found


def _function(module: ModuleType, way: str) -> Callable[..., Any]:
    function: Callable[..., Any] = module.packed if way == PACKED else module.PLAIN
    return function


@contextlib.contextmanager
def _robot(
    module: ModuleType, way: str, endpoint: str, *, config: PackingConfig, states: TaskStates
) -> Iterator[Offloader]:
    """A robot that sends its arguments in this way."""
    trace = config.out / f"{module.__name__.rpartition('_')[2]}-{way}.jsonl"
    trace.unlink(missing_ok=True)
    settings = Settings(predictor=PARTS, heartbeats=True, compress=way == AUTOMATIC, states=states)
    with Offloader.connect(
        endpoint, policy=CLOUD, timeout_s=TIMEOUT_S, trace=trace, settings=settings
    ) as offload:
        if absent := offload.wait_for_sites(_function(module, way), READY_S):
            raise OffloadError(str(absent))
        yield offload


def _measured(
    offload: Offloader, function: Callable[..., Any], args: tuple[Any, ...], same: Callable[..., bool]
) -> Measured | None:
    """Run a task on both sites, one after the other; None during the warm-up."""
    answer = offload(function, *args, where=CLOUD)
    record = offload.last
    expected = offload(function, *args, where=ONBOARD)
    assert record is not None
    assert offload.last is not None
    cloud, onboard = record.sites[CLOUD], record.sites[ONBOARD]
    (ran,) = [one for one in record.executions if one.site == CLOUD]
    if not ran.ok:
        raise OffloadError(f"the cloud did not answer: {ran.error}")
    if cloud.predicted_s is None or onboard.predicted_s is None or cloud.observations < WARM_UP:
        return None
    return Measured(
        how=", ".join(sorted({one.how for one in ran.packed if one.bytes < one.raw_bytes})),
        raw_bytes=payload_bytes(args),
        sent_bytes=ran.bytes_out,
        pack_s=ran.pack_s,
        predicted_s=cloud.predicted_s,
        seconds=ran.seconds,
        predicted_onboard_s=onboard.predicted_s,
        onboard_s=offload.last.executions[0].seconds,
        equal=same(answer, expected),
    )


def row(way: str, known: Sequence[Measured]) -> list[str]:
    """Medians over the tasks, and counts."""
    hows = [one.how or "nothing" for one in known]
    choice = ", ".join(f"{how} {hows.count(how)}" for how in sorted(set(hows)))
    errors = [abs(one.predicted_s - one.seconds) / one.seconds for one in known]
    return [
        way,
        choice,
        f"{statistics.median(one.raw_bytes for one in known) / 1e3:.0f}",
        f"{statistics.median(one.sent_bytes for one in known) / 1e3:.0f}",
        f"{statistics.median(one.pack_s for one in known) * 1e3:.1f}",
        f"{statistics.median(one.predicted_s for one in known) * 1e3:.0f}",
        f"{statistics.median(one.seconds for one in known) * 1e3:.0f}",
        f"{statistics.median(errors):.0%}",
        f"{statistics.median(one.onboard_s for one in known) * 1e3:.0f}",
        str(sum(one.predicted_s < one.predicted_onboard_s for one in known)),
        str(sum(one.seconds < one.onboard_s for one in known)),
        f"{sum(one.equal for one in known)} of {len(known)}",
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
