"""What a step printed, and everything that says how: commit, date, machine and commands, as one JSON file.

`measure` runs the commands of a step; nothing else makes such a file.
"""

import contextlib
import fcntl
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import IO

from benchmarks.figures.step import OUT, ROOT, Step, Unit
from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.loadgen.play.machine import StolenCpuTime
from offboard.loadgen.play.machine import machine as this_machine
from offboard.loadgen.table.measured_rows import write_whole

# A command is ended after LIMIT_FACTOR times the minutes that its step is expected to take, and LIMIT_MORE_S.
LIMIT_FACTOR, LIMIT_MORE_S = 5.0, 600.0
END_S = 30.0  # for a command to end after Ctrl-C
BUILD_S = 3600.0
OUTPUT_MAX = 1_000_000  # characters
SAID_LINES = 3  # of a command that failed
LOGS = Path("out/figures")
OTHER_FILES = "of rows or scenarios that have changed since"


@dataclass(frozen=True)
class Measured:
    """The result of a step or of one part of it, as its file holds it."""

    commit: str
    date: str  # when it began, in UTC; older files hold the day only
    machine: Mapping[str, str | int | float]
    stolen_percent: float | None
    commands: Sequence[str]
    reads: Mapping[str, Mapping[str, str]]
    seconds: float
    output: Sequence[str]

    @classmethod
    def read(cls, path: Path) -> "Measured":
        try:
            return cls(**json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise DataError(f"{path}: not a file of `make figures`: {error}") from None

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n")


def measure(unit: Unit, commit: str, *, again: bool = False) -> Measured:
    """Run the commands of a step and return what they printed; OffloadError if one fails.

    Runs that were finished at this commit are used, but not with `again`.
    """
    for target in unit.step.ready:
        _build(target)
    if any(OUT in command for command in unit.step.run):
        _prepare(unit, commit, again=again)
    here = machine_of(_environment(unit.step))
    reads, stolen, began = unit.reads(ROOT), StolenCpuTime(), time.monotonic()
    date, output = f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}", ""
    for command in unit.commands():
        output += _run(unit, command)
    if not output.strip():
        raise OffloadError("nothing was printed")
    if len(output) > OUTPUT_MAX:
        raise OffloadError(f"{len(output)} characters were printed, at most {OUTPUT_MAX} are kept")
    percent = stolen.percent()
    return Measured(
        commit=commit,
        date=date,
        machine=here,
        stolen_percent=None if percent is None else round(percent, 1),
        commands=unit.commands(),
        reads=reads,
        seconds=round(time.monotonic() - began, 1),
        output=[line.rstrip() for line in output.strip().splitlines()],
    )


def keep(unit: Unit, measured: Measured) -> None:
    """Write the file of a step, and copy its pictures."""
    for source, target in unit.copies().items():
        shutil.copyfile(ROOT / source, ROOT / target)
    measured.write(ROOT / unit.file)


def why_old(unit: Unit, measured: Measured | None, commit: str) -> str:
    """Why a step must be measured, or "" if its file is up to date."""
    if measured is None:
        return "not measured"
    if measured.commit != commit:
        return f"of commit {measured.commit}"
    if list(measured.commands) != unit.commands():
        return "of other commands"
    return OTHER_FILES if of_other_files(unit, measured) else ""


def of_other_files(unit: Unit, measured: Measured) -> bool:
    """Whether rows or scenarios that a step read have changed since."""
    try:
        now = {name: about["sha256"] for name, about in unit.reads(ROOT).items()}
    except OffloadError:
        return True
    return now != {name: about["sha256"] for name, about in measured.reads.items()}


def read_all(units: Sequence[Unit], root: Path = ROOT) -> dict[str, Measured]:
    """The results that there are, by the name of the step or part."""
    there = [unit for unit in units if (root / unit.file).is_file()]
    return {unit.name: Measured.read(root / unit.file) for unit in there}


def machine_of(environment: Mapping[str, str]) -> dict[str, str | int | float]:
    """The machine and the Python of an environment; OffloadError if it runs the code of another checkout."""
    code = "import sys; del sys.path[0]\n"  # what a program of the environment imports, whatever the folder
    code += "import platform, offboard; print(platform.python_version(), offboard.__file__)"
    python = shutil.which("python", path=environment["PATH"]) or "python"
    asked = subprocess.run(
        [python, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=END_S,
    )
    version, module = asked.stdout.strip().split(maxsplit=1)
    if not Path(module).is_relative_to(ROOT):
        raise OffloadError(f"{python} runs the code of {Path(module).parents[1]}")
    return {**this_machine(), "python": version}


def _environment(step: Step) -> dict[str, str]:
    """That of a user who has activated the environment of the step; tables are as wide as everywhere."""
    folder = ROOT / step.environment / "bin"
    if not (folder / "python").exists():
        raise OffloadError(f"{step.environment} is missing: `make figures` builds it")
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "COLUMNS": "100"}


def _prepare(unit: Unit, commit: str, *, again: bool) -> None:
    """Empty the folder of a step, unless its commands have begun at this commit."""
    mark, made = ROOT / unit.work / ".made", "\n".join([commit, *unit.commands()])
    if again or not mark.is_file() or mark.read_text() != made:
        if mark.parent.exists():
            shutil.rmtree(mark.parent)
        mark.parent.mkdir(parents=True)
        mark.write_text(made)


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Nobody else measures figures here meanwhile, and a signal to end also ends the command under way."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores it
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as with nohup
            signal.signal(number, signal.default_int_handler)
    lock = ROOT / LOGS / ".lock"
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError("another `make figures` measures here: wait until it has ended") from None
        yield


def _build(target: str) -> None:
    with _started(["make", target], dict(os.environ), sys.stderr, sys.stderr) as process:
        code = process.wait(timeout=BUILD_S)
    if code:
        raise OffloadError(f"`make {target}` failed")


def _run(unit: Unit, command: str) -> str:
    """What a command printed to stdout; stderr goes to a log."""
    log = ROOT / LOGS / f"{unit.name.replace('/', '-')}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    limit_s = LIMIT_FACTOR * 60 * unit.step.minutes + LIMIT_MORE_S
    environment = _environment(unit.step)
    words = shlex.split(command)
    program = shutil.which(words[0], path=environment["PATH"])
    if program is None:
        raise OffloadError(f"`{command}`: there is no program {words[0]}")
    try:
        with (
            log.open("w") as errors,
            _started([program, *words[1:]], environment, subprocess.PIPE, errors) as process,
        ):
            output, _ = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise OffloadError(f"`{command}` has not ended after {limit_s / 60:.0f} minutes") from None
    if process.returncode:
        said = " / ".join(log.read_text().strip().splitlines()[-SAID_LINES:])
        raise OffloadError(f"`{command}` ended with exit code {process.returncode}: {said}")
    return f"{output.rstrip()}\n\n"


@contextlib.contextmanager
def _started(
    words: Sequence[str], environment: Mapping[str, str], stdout: IO[str] | int, stderr: IO[str]
) -> "Iterator[subprocess.Popen[str]]":
    """A command in a process group of its own, which ends with the block at the latest."""
    process = subprocess.Popen(
        words,
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            _end(process)


def _end(process: "subprocess.Popen[str]") -> None:
    """End a command and its processes as Ctrl-C does; kill what is left after END_S or a second Ctrl-C."""
    try:
        with contextlib.suppress(subprocess.TimeoutExpired, ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
            process.communicate(timeout=END_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=END_S)
