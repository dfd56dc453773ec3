"""`robot-client`: a simulated robot that plans on a real map, each plan where its policy says."""

import logging
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NoReturn

from common.config import as_dict, load, run_command
from common.errors import ConfigError, OffloadError
from robot_client.config import RobotConfig
from robot_client.runner import ONBOARD, PORT_MAX
from robot_client.trace import Record

log = logging.getLogger("robot_client")


def main(argv: Sequence[str] | None = None) -> int:
    arguments = sys.argv[1:] if argv is None else argv
    return run_command("robot-client", lambda: _run(arguments))


def _run(argv: Sequence[str]) -> int:
    config = load(
        RobotConfig,
        argv,
        prog="robot-client",
        description="Drive a simulated robot over a map; each plan runs onboard or in the cloud.",
        environ=os.environ,
        prefix="ROBOT",
    )
    logging.basicConfig(level=config.log.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    log.info("config %s", as_dict(config))
    signal.signal(signal.SIGTERM, _interrupt)
    return _drive(config)


def _drive(config: RobotConfig) -> int:
    # Loaded after the flags are read: --help answers without compiling anything.
    from common.planner import plan_path
    from robot_client.drive import Drive, read_prior
    from robot_client.offloader import Offloader
    from robot_client.trace import Trace, alone_path

    prior = read_prior(config.map, config.resolution)
    trace = Trace(config.trace) if config.trace else None
    alone = Trace(alone_path(config.trace)) if config.trace and config.alone else None
    observers = ([trace.write] if trace else []) + _metrics(config)
    connect = partial(Offloader.connect, config.cloud, timeout_s=config.timeout_s)
    try:
        with connect(
            sites=config.sites(),
            policy=config.policy,
            predictor=config.predictor,
            window=config.window,
            seed=config.seed,
            observers=observers,
        ) as offload:
            drive = Drive(config, prior, offload, print)
            with connect(sites=config.sites()) as unseen:
                absent = unseen.wait_for_sites(plan_path, config.connect_s)
                drive.warm(unseen)
            _say_absent("starting", absent or offload.wait_for_sites(plan_path, config.connect_s))
            drive.run()
        if alone:
            # An offloader of its own: what the run learnt, wrote and counted is of the run alone.
            with connect(observers=[alone.write]) as offload:
                _say_absent("measuring", offload.wait_for_sites(plan_path, config.connect_s))
                drive.run_alone(offload)
    finally:
        for file in (trace, alone):
            if file:
                file.close()
    for file in (trace, alone):
        if file and file.lost:
            raise OffloadError(f"{file.lost} tasks are not in {file.path}")
    return 0


def _say_absent(doing: str, absent: Mapping[str, str]) -> None:
    for site, why in absent.items():
        log.warning("%s without %s: %s; tasks run %s", doing, site, why, ONBOARD)


def _metrics(config: RobotConfig) -> list[Callable[[Record], None]]:
    if config.metrics is None:
        return []
    from prometheus_client import CollectorRegistry

    from robot_client.metrics import Metrics

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
