"""The files in the folder of a run: their names, which robot writes which, and clearing old ones away.

What is in them is described in docs/formats.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen import robot_files
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.testbed.testbed import ROBOT, WAN

TRACE = "trace.jsonl"
ANSWERS = "answers.jsonl"
LINK = "link.jsonl"  # of the relay of `cloud`; that of `edge` writes link-edge.jsonl
EVENTS = "events.jsonl"
READINGS = "usage.jsonl"
SUMMARY = robot_files.SUMMARY
PICTURE = "plan.png"
ROBOT_SEED_STEP = 1_000_003  # large: robots of one run differ, and so do runs with neighbouring seeds


@dataclass(frozen=True, slots=True)
class RobotFiles:
    """The files that one robot of a run writes, and the seed of its tasks."""

    robot: str
    trace: Path
    answers: Path
    seed: int

    @classmethod
    def of(cls, scenario: Scenario, out: Path) -> "Iterator[RobotFiles]":
        """One for each robot. Only the first robot's files have names without a number."""
        for n, robot in enumerate(scenario.robots()):
            suffix = robot.removeprefix(ROBOT)
            trace, answers = (out / name.replace(".", f"{suffix}.", 1) for name in (TRACE, ANSWERS))
            yield cls(robot, trace, answers, scenario.seed + n * ROBOT_SEED_STEP)


def link_file(out: Path, relay: str) -> Path:
    """The file in which a relay records what its link did."""
    path = out / LINK
    return path.with_stem(f"{path.stem}{relay.removeprefix(WAN)}")


class LineCounter:
    """Counts the whole lines of a file that grows; reads every byte once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._count = self._read = 0

    def count(self) -> int:
        if self.path.exists():
            with self.path.open("rb") as file:
                file.seek(self._read)
                new = file.read()
            self._count += new.count(b"\n")
            self._read += len(new)
        return self._count


def find_source(path: Path) -> Path:
    """The trace in the folder of a run, or the file itself."""
    if path.is_dir():
        if not (path / TRACE).is_file():
            raise DataError(f"{path}: this folder has no {TRACE}; `loadgen run` and `loadgen demo` write one")
        return path / TRACE
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; give the folder of a run, a trace, or a CSV file")
    return path


def clear_folder(out: Path) -> None:
    """Make the folder of a run, or remove what an earlier run left in it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("trace*.jsonl", "answers*.jsonl", "link*.jsonl", EVENTS, READINGS, SUMMARY, PICTURE):
            for left in out.glob(name):
                left.unlink()
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written to: {error.strerror}") from error
