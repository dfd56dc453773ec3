"""The flags that say how many tasks there are, when they start, what is measured and what is written."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.common.host.logs import JSON, LEVELS, TEXT
from offboard.loadgen.robot.workload import ARRIVALS, CLOSED

TASKS_DEFAULT = 200
TASKS, ARRIVING, MEASURING, OUTPUT = "tasks", "arrivals", "measurement", "output"


@dataclass(frozen=True)
class RunSettings:
    """One run of tasks, whatever they are."""

    tasks: int | None = setting(
        None,
        f"number of tasks (default: {TASKS_DEFAULT}, or all inputs if they end earlier)",
        group=TASKS,
        minimum=1,
        maximum=1_000_000,
    )
    seed: int = setting(1, "seed of everything that is drawn at random", group=TASKS, minimum=0)
    arrivals: str = setting(
        CLOSED,
        "closed: start the next task when the previous one finishes; others: start at --rate regardless",
        group=ARRIVING,
        choices=ARRIVALS,
    )
    rate: float | None = setting(
        None,
        "tasks per second, unless --arrivals is closed",
        group=ARRIVING,
        minimum=0.001,
        maximum=100_000,
    )
    burst: int = setting(
        10,
        "with --arrivals bursts: tasks that start at the same time",
        group=ARRIVING,
        rare=True,
        minimum=1,
        maximum=1_000_000,
    )
    in_flight: int = setting(
        16,
        "unless --arrivals is closed: tasks that may run at the same time; further tasks start late",
        group=ARRIVING,
        rare=True,
        minimum=1,
        maximum=1024,
    )
    trace: Path | None = setting(None, "append one JSON line per task to this file", group=OUTPUT)
    answers: Path | None = setting(
        None,
        "append the answer of each task to this file as one JSON line; a run that finds answers there "
        "goes on after them",
        group=OUTPUT,
        rare=True,
    )
    metrics: str | None = setting(
        None, "serve Prometheus metrics at this address", group=OUTPUT, rare=True, metavar="HOST:PORT"
    )
    log: str = setting(
        "warning",
        "least severe messages that are logged",
        group=OUTPUT,
        rare=True,
        choices=LEVELS,
    )
    log_format: str = setting(
        TEXT,
        "form of the lines of the log: text, or a JSON object each",
        group=OUTPUT,
        rare=True,
        choices=(TEXT, JSON),
    )
    measure: int = setting(0, "run the first K tasks on both sites", group=MEASURING, rare=True, minimum=0)
    alone: int = setting(
        0,
        "after the run, measure K further tasks onboard alone, in the cloud alone and on both at once; "
        "writes NAME.alone.jsonl next to --trace",
        group=MEASURING,
        rare=True,
        minimum=0,
    )
    reference: int = setting(
        0,
        "run every K-th task again on each site alone; writes NAME.reference.jsonl next to --trace; "
        "0 is never",
        group=MEASURING,
        rare=True,
        minimum=0,
        maximum=1_000_000,
    )

    @property
    def tasks_max(self) -> int:
        """The number of tasks; without --tasks, inputs may end earlier."""
        return TASKS_DEFAULT if self.tasks is None else self.tasks

    def check_run(self, *, cloud: str | None) -> None:
        """`cloud` is the endpoint of the server that --alone and --reference need."""
        if self.answers is not None and self.answers == self.trace:
            raise ConfigError(f"--answers: {self.answers} is also the file of --trace")
        for flag in ("measure", "alone"):
            if getattr(self, flag) > self.tasks_max:
                raise ConfigError(f"--{flag}: {getattr(self, flag)} is above --tasks {self.tasks_max}")
        for flag in ("alone", "reference"):
            for needed, value in (("trace", self.trace), ("cloud", cloud)):
                if getattr(self, flag) and value is None:
                    raise ConfigError(f"--{flag}: {getattr(self, flag)} needs --{needed}")
        if self.arrivals != CLOSED:
            self._check_open()
        elif self.rate is not None:
            raise ConfigError(f"--rate: {self.rate:g} needs --arrivals, which is {CLOSED} otherwise")

    def _check_open(self) -> None:
        if self.rate is None:
            raise ConfigError(f"--arrivals: {self.arrivals} needs --rate, the tasks per second")
        for flag in ("measure", "alone", "reference"):
            if getattr(self, flag):
                raise ConfigError(f"--{flag}: {getattr(self, flag)} needs --arrivals {CLOSED}")
