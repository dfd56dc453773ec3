"""`robot-client`: a simulated robot that plans on a real map, or calls of a task; where its policy says."""

import gc
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from offboard.common.config import as_dict, load, run_command
from offboard.common.errors import ConfigError, OffloadError
from offboard.robot_client.simulated.config import RobotConfig
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, PORT_MAX

if TYPE_CHECKING:
    from offboard.robot_client.records.lines import Lines
    from offboard.robot_client.records.trace import Record


def main(argv: Sequence[str] | None = None) -> int:
    arguments = sys.argv[1:] if argv is None else argv
    command = _make_keys if arguments[:1] == ["keys"] else _run
    return run_command("robot-client", lambda: command(arguments))


def _make_keys(argv: Sequence[str]) -> int:
    from offboard.common.security.keys import ROBOT, run_keys

    run_keys(ROBOT, argv[1:], prog="robot-client keys", prefix="ROBOT_KEYS", environ=os.environ)
    return 0


def _run(argv: Sequence[str]) -> int:
    config = load(
        RobotConfig,
        argv,
        prog="robot-client",
        description="Drive a simulated robot over a map, or call a task; each runs onboard or in the cloud. "
        "`robot-client keys` makes its keys.",
        environ=os.environ,
        prefix="ROBOT",
    )
    import logging  # not for --help

    logging.basicConfig(level=config.log.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger("offboard.robot_client").info("config %s", as_dict(config))
    signal.signal(signal.SIGTERM, _interrupt)
    return _drive(config)


def _drive(config: RobotConfig) -> int:
    # Loaded after the flags are read: --help answers without compiling anything.
    from offboard.robot_client.offloader import Offloader
    from offboard.robot_client.records.trace import Trace, alone_path, reference_path
    from offboard.robot_client.simulated.answers import Answers
    from offboard.robot_client.simulated.drive import Drive, OwnRecord
    from offboard.robot_client.simulated.references import References
    from offboard.robot_client.simulated.task_source import make_work

    if config.task is not None:
        sys.path.insert(0, str(Path.cwd()))  # as `python -m` does, so that --task finds the user's modules
    own = OwnRecord()
    connect = partial(Offloader.connect, config.cloud, timeout_s=config.timeout_s, keys=config.keys)
    answers = Answers(config.answers) if config.answers else None
    if answers and answers.done and config.map and not config.jump:
        raise ConfigError(
            f"--answers: {answers.path} holds {len(answers.done)} answers; going on needs --jump"
        )
    trace = Trace(config.trace) if config.trace else None
    alone = Trace(alone_path(config.trace)) if config.trace and config.alone else None
    files: list[Answers | Lines] = [file for file in (answers, trace, alone) if file]
    observers: list[Callable[[Record], None]] = [own, *([trace.write] if trace else []), *_metrics(config)]
    try:
        work = make_work(config)
        with ExitStack() as stack:
            offload = stack.enter_context(
                connect(
                    sites=config.sites(),
                    policy=config.policy,
                    window=config.window,
                    observers=observers,
                    settings=config.settings(),
                )
            )
            again, references = None, None
            if config.trace and config.reference:
                again = stack.enter_context(connect(sites=config.sites()))
                sites = [ONBOARD, CLOUD, *config.sites()]
                path, every = reference_path(config.trace), config.reference
                references = References(path, again, sites, every=every, tasks=config.tasks, seed=config.seed)
                files.append(references)
            for file in files:
                if file is not alone:  # closed before the sites are: what is given up then has no record
                    stack.callback(file.close)
            drive = Drive(config, work, offload, own, print, answers=answers, references=references)
            with connect(sites=config.sites()) as unseen:
                absent = unseen.wait_for_sites(work.function, config.connect_s)
                drive.warm(unseen)
            absent = absent or offload.wait_for_sites(work.function, config.connect_s)
            if again:
                absent = absent or again.wait_for_sites(work.function, config.connect_s)
                drive.warm(again)
            _say_absent("starting", absent)
            gc.collect()
            gc.freeze()  # what is there before the first task stays: no collection looks at it again
            drive.run()
        if alone:
            # An offloader of its own: what the run learnt, wrote and counted is of the run alone.
            with connect(observers=[alone.write]) as offload:
                _say_absent("measuring", offload.wait_for_sites(work.function, config.connect_s))
                drive.run_alone(offload)
    finally:
        for file in files:
            file.close()
    for file in files:
        if file.lost:
            raise OffloadError(f"{file.lost} tasks are not in {file.path}")
    return 0


def _say_absent(doing: str, absent: Mapping[str, str]) -> None:
    import logging

    for site, why in absent.items():
        logging.getLogger("offboard.robot_client").warning(
            "%s without %s: %s; tasks run %s", doing, site, why, ONBOARD
        )


def _metrics(config: RobotConfig) -> "list[Callable[[Record], None]]":
    if config.metrics is None:
        return []
    from prometheus_client import CollectorRegistry

    from offboard.robot_client.records.metrics import Metrics

    host, _, port = config.metrics.rpartition(":")
    if not host or not port.isdecimal() or int(port) > PORT_MAX:
        raise ConfigError(f"--metrics: {config.metrics!r} is not HOST:PORT with a port 0 to {PORT_MAX}")
    metrics = Metrics(CollectorRegistry())
    try:
        metrics.serve(host, int(port))
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"--metrics: {config.metrics} cannot be served: {error}") from error
    return [metrics]


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
