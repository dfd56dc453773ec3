"""The commands `loadgen drive` and `loadgen call`: builds what a run needs, runs it and closes its files.

The settings are read in `__main__`; the tasks are asked for in `run`.
"""

import gc
import logging
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from offboard.common.config import as_dict, flag_of, settings_of
from offboard.common.errors import ConfigError, OffloadError
from offboard.common.logs import start_log
from offboard.common.task_states import TaskStates
from offboard.loadgen.progress import progress
from offboard.loadgen.robot.answers import Answers
from offboard.loadgen.robot.config import CallConfig, DriveConfig, Planning, RobotConfig
from offboard.loadgen.robot.references import References, measure_alone
from offboard.loadgen.robot.run import OwnRecord, Run
from offboard.loadgen.robot.stream_run import run_stream
from offboard.loadgen.robot.work import Plans, Work, make_work
from offboard.loadgen.robot_files import alone_path, reference_path
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.lines import Lines
from offboard.robot_client.records.record import Record
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

if TYPE_CHECKING:
    from offboard.loadgen.map_picture import LastPlan
    from offboard.robot_client.records.metrics import Metrics

log = logging.getLogger(__name__)


def run_robot(config: RobotConfig) -> int:
    """Run the tasks, then measure those of --alone."""
    start_log(config.log, config.log_format)
    log.info("settings: %s", as_dict(config))
    answers = Answers(config.answers) if config.answers else None
    if answers and answers.done and isinstance(config, DriveConfig) and not config.jump:
        raise ConfigError(
            f"--answers: {answers.path} holds {len(answers.done)} answers; going on after them needs --jump"
        )
    trace = Trace(config.trace) if config.trace else None
    alone = Trace(alone_path(config.trace)) if config.trace and config.alone else None
    files: list[Answers | Lines] = [file for file in (answers, trace) if file]
    try:
        work, states = make_work(config), TaskStates(workers=1)  # shared, so that each setup runs once
        if isinstance(config, DriveConfig) and isinstance(work, Plans):
            write_drive_record(config, work)
        last = _last_plan(config)
        _run_tasks(config, work, states, answers, trace=trace, files=files, last=last)
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
    if last:
        print(last.write())
    return 0


def write_drive_record(config: DriveConfig, work: Plans) -> None:
    """Write the drive record, if the run has a trace and answers with which it can be used."""
    from offboard.loadgen.drive_record import DriveRecord  # it loads the planner, which a call does not need

    if config.trace is None or config.answers is None:
        return
    names = {flag_of(field) for field in settings_of(Planning)} | {"seed"}
    settings = {name: value for name, value in as_dict(config).items() if name in names and value is not None}
    DriveRecord(config.answers, settings, work.robot.prior).write(config.trace)


def _run_tasks(
    config: RobotConfig,
    work: Work,
    states: TaskStates,
    answers: Answers | None,
    *,
    trace: Trace | None,
    files: list[Answers | Lines],
    last: "LastPlan | None",
) -> None:
    """Run the tasks of `work`, then close `files`, to which the file of --reference is added."""
    own, sites = OwnRecord(), config.sites or config.further()
    with ExitStack() as stack:
        offload = stack.enter_context(_observed(config, states, own, trace))
        again, references = None, None
        if config.trace and config.reference:
            again = stack.enter_context(_connect(config, states=states, sites=sites))
            path, names = reference_path(config.trace), [ONBOARD, CLOUD, *config.further()]
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
        keep = last.keep if last else None
        run = Run(
            config, work, offload, own=own, say=print, answers=answers, references=references, keep=keep
        )
        with (
            _connect(config, states=states, sites=sites) as unseen,
            progress("connecting, and compiling what the first task needs", to=sys.stdout),
        ):
            absent = unseen.wait_for_sites(work.function, config.connect_s)
            run.warm(unseen)
        absent = absent or offload.wait_for_sites(work.function, config.connect_s)
        if again:
            absent = absent or again.wait_for_sites(work.function, config.connect_s)
            run.warm(again)
        _warn_of_absent("starting", absent)
        gc.collect()
        gc.freeze()  # so that collections during the run do not look at what exists now
        if isinstance(config, CallConfig) and config.stream_hz is not None:
            run_stream(config, work, offload, say=print, answers=answers)
        else:
            run.run()


def _observed(config: RobotConfig, states: TaskStates, own: OwnRecord, trace: Trace | None) -> Offloader:
    """The offloader whose tasks go into the trace, the metrics and the live page."""
    metrics = _metrics(config, trace)
    observers: list[Callable[[Record], None]] = [
        own,
        *([trace.write] if trace else []),
        *([metrics] if metrics else []),
    ]
    settings = config.settings()
    offload = _connect(
        config,
        states,
        settings,
        sites=config.sites or config.further(),
        policy=config.policy,
        observers=observers,
    )
    if metrics:
        offload.show_on(metrics.live)
    return offload


def _connect(
    config: RobotConfig, states: TaskStates, settings: Settings | None = None, **options: Any
) -> Offloader:
    own = replace(settings or Settings(insecure=config.insecure), states=states)
    return Offloader.connect(
        config.cloud, timeout_s=config.timeout_s, keys=config.keys, settings=own, **options
    )


def _last_plan(config: RobotConfig) -> "LastPlan | None":
    """What draws the picture of --picture."""
    if not isinstance(config, DriveConfig) or config.picture is None:
        return None
    from offboard.loadgen.map_picture import LastPlan  # importing the planner compiles it

    return LastPlan(config.picture)


def _warn_of_absent(doing: str, absent: Mapping[str, str]) -> None:
    for site, why in absent.items():
        instead = "tasks run elsewhere" if site == ONBOARD else f"tasks run {ONBOARD}"
        remedy = "correct the setup of the task" if site == ONBOARD else "robot-client check"
        log.warning("%s without %s: %s; %s; remedy: %s", doing, site, why, instead, remedy)


def _metrics(config: RobotConfig, trace: Trace | None) -> "Metrics | None":
    """The observer that serves metrics until the process ends, if an address is given for it."""
    if config.metrics is None:
        return None
    from offboard.robot_client.records.metrics import serve_metrics  # its library takes long to load

    metrics = serve_metrics(config.metrics, "--metrics")
    if trace:
        metrics.watch(trace)
    return metrics
