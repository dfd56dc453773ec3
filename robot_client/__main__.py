"""`robot-client`: its commands, and the parts that they are built from.

What a command does is in `simulated` (drive, call), `check` and `common.security.keys`.
"""

import gc
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from offboard.common.command_line import Command, CommandParser, add_flags, load, run_commands
from offboard.common.config import as_dict, resolve
from offboard.common.errors import ConfigError, OffloadError
from offboard.robot_client.settings import Settings
from offboard.robot_client.simulated.config import CallConfig, DriveConfig, RobotConfig
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, check_endpoint

if TYPE_CHECKING:
    from offboard.common.task_states import TaskStates
    from offboard.robot_client.offloader import Offloader
    from offboard.robot_client.records.lines import Lines
    from offboard.robot_client.records.trace import Record, Trace
    from offboard.robot_client.simulated.answers import Answers
    from offboard.robot_client.simulated.work import Work

C = TypeVar("C", bound=RobotConfig)
Observer = Callable[["Record"], None]

PREFIX = "ROBOT"


def main(argv: Sequence[str] | None = None) -> int:
    about = "Runs tasks onboard or in the cloud, wherever they finish first."
    return run_commands("robot-client", about, COMMANDS, sys.argv[1:] if argv is None else argv)


def _drive(argv: Sequence[str]) -> int:
    about = "Drive a simulated robot on a map. Each of its paths is planned onboard or in the cloud."
    return _run(_load(DriveConfig, argv, "drive", about))


def _call(argv: Sequence[str]) -> int:
    about = (
        "Call a task with numbers or with inputs of yours, one after the other or at a rate. "
        "Each call runs onboard or in the cloud."
    )
    return _run(_load(CallConfig, argv, "call", about))


def _check(argv: Sequence[str]) -> int:
    from offboard.robot_client.check.check_config import CheckConfig

    about = "Check step by step whether this robot can use a server. Each failed step comes with a remedy."
    parser = CommandParser(prog="robot-client check", description=about, operands="ENDPOINT")
    parser.add_argument("endpoint", metavar="ENDPOINT", help="tcp://HOST:PORT of the server")
    add_flags(parser, CheckConfig, "ROBOT_CHECK")
    flags = parser.parse_args(argv)
    config = resolve(CheckConfig, flags, environ=os.environ, prefix="ROBOT_CHECK")
    check_endpoint("ENDPOINT", flags.endpoint)
    _find_modules_here()
    import logging

    from offboard.robot_client.check.outcome import FAIL
    from offboard.robot_client.check.steps import Check

    logging.disable(logging.WARNING)  # the lines say the same
    check = Check(flags.endpoint, keys=config.keys, modules=config.tasks, timeout_s=config.timeout_s)
    failed = False
    for line in check.run():
        print(line, flush=True)
        failed = failed or line.status == FAIL
    return int(failed)


def _make_keys(argv: Sequence[str]) -> int:
    from offboard.common.security.keys import ROBOT, run_keys

    run_keys(ROBOT, argv, prog="robot-client keys", prefix="ROBOT_KEYS", environ=os.environ)
    return 0


def _load(cls: type[C], argv: Sequence[str], command: str, about: str) -> C:
    prog = f"robot-client {command}"
    config = load(cls, argv, prog=prog, description=about, environ=os.environ, prefix=PREFIX)
    import logging  # not for --help

    logging.basicConfig(level=config.log.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger("offboard.robot_client").info("settings: %s", as_dict(config))
    signal.signal(signal.SIGTERM, _interrupt)
    return config


def _find_modules_here() -> None:
    """Let modules in the current folder be imported, as `python -m` does."""
    sys.path.insert(0, str(Path.cwd()))


def _run(config: RobotConfig) -> int:
    """Run the tasks, then measure those of --alone."""
    # These are imported after the flags are read, so that --help compiles nothing.
    from offboard.common.task_states import TaskStates
    from offboard.robot_client.records.trace import Trace, alone_path
    from offboard.robot_client.simulated.answers import Answers
    from offboard.robot_client.simulated.references import measure_alone
    from offboard.robot_client.simulated.work import make_work

    _find_modules_here()
    answers = Answers(config.answers) if config.answers else None
    if answers and answers.done and isinstance(config, DriveConfig) and not config.jump:
        raise ConfigError(
            f"--answers: {answers.path} holds {len(answers.done)} answers; going on after them needs --jump"
        )
    trace = Trace(config.trace) if config.trace else None
    alone = Trace(alone_path(config.trace)) if config.trace and config.alone else None
    files: list[Answers | Lines] = [file for file in (answers, trace) if file]
    try:
        observers: list[Observer] = [*([trace.write] if trace else []), *_metrics(config, trace)]
        work, states = make_work(config), TaskStates(workers=1)  # shared, so that each setup runs once
        _run_tasks(config, work, states, answers, observers=observers, files=files)
        if alone:
            # With its own offloader: what the run learns, records and counts is about the run only.
            with _connect(config, states=states, observers=[alone.write]) as offload:
                _warn_of_absent("measuring", offload.wait_for_sites(work.function, config.connect_s))
                measure_alone(config, work, offload, print)
    finally:
        files += [alone] if alone else []
        for file in files:
            file.close()
    for file in files:
        if file.lost:
            raise OffloadError(f"{file.lost} tasks could not be written to {file.path}")
    return 0


def _run_tasks(
    config: RobotConfig,
    work: "Work",
    states: "TaskStates",
    answers: "Answers | None",
    *,
    observers: Sequence[Observer],
    files: "list[Answers | Lines]",
) -> None:
    """Run the tasks of `work`, then close `files`, to which the file of --reference is added."""
    from offboard.robot_client.records.trace import reference_path
    from offboard.robot_client.simulated.references import References
    from offboard.robot_client.simulated.run import OwnRecord, Run

    own, sites = OwnRecord(), config.sites()
    with ExitStack() as stack:
        offload = stack.enter_context(
            _connect(
                config,
                states=states,
                sites=sites,
                policy=config.policy,
                window=config.window,
                settings=config.settings(config.seed),
                observers=[own, *observers],
            )
        )
        again, references = None, None
        if config.trace and config.reference:
            again = stack.enter_context(_connect(config, states=states, sites=sites))
            path, names = reference_path(config.trace), [ONBOARD, CLOUD, *sites]
            references = References(
                path,
                again,
                names,
                every=config.reference,
                tasks=config.tasks_max,
                seed=config.seed,
                states=states,
            )
            files.append(references)
        for file in files:
            # Before the sites are closed: tasks that are given up by then have no record.
            stack.callback(file.close)
        run = Run(config, work, offload, own=own, say=print, answers=answers, references=references)
        with _connect(config, states=states, sites=sites) as unseen:
            absent = unseen.wait_for_sites(work.function, config.connect_s)
            run.warm(unseen)
        absent = absent or offload.wait_for_sites(work.function, config.connect_s)
        if again:
            absent = absent or again.wait_for_sites(work.function, config.connect_s)
            run.warm(again)
        _warn_of_absent("starting", absent)
        gc.collect()
        gc.freeze()  # so that collections during the run do not look at what exists now
        run.run()


def _connect(
    config: RobotConfig, states: "TaskStates", settings: Settings | None = None, **options: Any
) -> "Offloader":
    from offboard.robot_client.offloader import Offloader

    own = replace(settings or Settings(), states=states)
    return Offloader.connect(
        config.cloud, timeout_s=config.timeout_s, keys=config.keys, settings=own, **options
    )


def _warn_of_absent(doing: str, absent: Mapping[str, str]) -> None:
    import logging

    for site, why in absent.items():
        instead = "tasks run elsewhere" if site == ONBOARD else f"tasks run {ONBOARD}"
        logging.getLogger("offboard.robot_client").warning("%s without %s: %s; %s", doing, site, why, instead)


def _metrics(config: RobotConfig, trace: "Trace | None") -> list[Observer]:
    """The observer that serves metrics until the process ends, if an address is given for it."""
    if config.metrics is None:
        return []
    from offboard.robot_client.records.metrics import serve_metrics

    metrics = serve_metrics(config.metrics, "--metrics")
    if trace:
        metrics.watch(trace)
    return [metrics]


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


COMMANDS = {
    "drive": Command("drive a simulated robot on a map", _drive),
    "call": Command("call a task of yours, with numbers or inputs", _call),
    "check": Command("check whether this robot can use a server", _check),
    "keys": Command("make the keys of this robot", _make_keys),
}

if __name__ == "__main__":
    sys.exit(main())
