"""`cloud-server`: builds the server from its settings, and runs it until a signal stops it."""

import logging
import os
import resource
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from offboard.cloud_server.config import MIB, ROBOTS, ServerConfig
from offboard.common.command_line import load, run_command
from offboard.common.config import as_dict
from offboard.common.errors import ConfigError
from offboard.common.logs import start_log

DESCRIPTION = (
    "Run tasks for robots. Robots connect over ZMQ; HTTP serves /live (a page), /health, /ready, /metrics, "
    "/config, /tasks and /docs. `cloud-server keys` makes the keys of the server."
)

EMPTY_TASK_MODULE = "offboard.common.empty_task"
SWITCH_S = 0.0005  # a thread that computes must let others run this often, so that replies are not delayed

log = logging.getLogger("offboard.cloud_server")


def main(argv: Sequence[str] | None = None) -> int:
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == ["keys"]:
        return run_command("cloud-server keys", lambda: make_keys(arguments[1:], os.environ))
    return run_command("cloud-server", lambda: serve(arguments, os.environ))


def make_keys(argv: Sequence[str], environ: Mapping[str, str]) -> int:
    """`cloud-server keys`: make the keys of the server, and the folder for the keys of its robots."""
    from offboard.common.security.keys import SERVER, run_keys

    folder = run_keys(SERVER, argv, prog="cloud-server keys", prefix="CLOUD_KEYS", environ=environ)
    robots = folder / ROBOTS
    try:
        robots.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {robots}: {error.strerror}") from error
    print(f"{robots}: copy the public key of each robot there, as NAME.key")
    return 0


def serve(argv: Sequence[str], environ: Mapping[str, str]) -> int:
    """Serve until SIGTERM or Ctrl-C; return 0 if every accepted request was answered, else 1."""
    config = load(
        ServerConfig, argv, prog="cloud-server", description=DESCRIPTION, environ=environ, prefix="CLOUD"
    )
    start_log(config.log, config.log_format)
    sys.path.insert(0, str(Path.cwd()))  # as `python -m` does, so that --tasks finds modules of the user
    # These load heavy libraries, which --help and a wrong flag do not need.
    from offboard.cloud_server.executors import EXECUTORS
    from offboard.cloud_server.http_api import make_http
    from offboard.cloud_server.metrics import Metrics
    from offboard.cloud_server.server import Limits, Server
    from offboard.common.security.address import warn_each_minute
    from offboard.common.security.keys import server_keys
    from offboard.common.security.plain_files import read_token

    sys.setswitchinterval(SWITCH_S)
    files_max = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (files_max, files_max))
    token = read_token(config.token_file)
    keys = server_keys(config.keys) if config.keys else None
    modules = load_tasks(config.tasks)
    log.info("settings: %s", as_dict(config))
    log.info("up to %d files may be open; each connected robot needs one", files_max)
    metrics = Metrics()
    limits = (config.blob_mib * MIB, config.worker_memory * MIB)
    of_ray = {"ray_address": config.ray_address, "ray_resources": config.resources}
    executor = EXECUTORS[config.executor](config.workers, modules, *limits, **of_ray)
    server = Server(
        config.listen,
        executor,
        metrics,
        Limits(
            queue_max=config.queue_max,
            blob_bytes_max=config.blob_mib * MIB,
            message_bytes_max=config.message_mib * MIB,
            robot_bytes_per_s=config.robot_mib_s * MIB,
            drain_s=config.drain_s,
        ),
        on_ready=lambda: log.info("ready: listening on %s, http://%s", server.endpoint, web.address),
        keys=keys,
        robots=config.robots_folder,
    )
    web = make_http(config, metrics, server, token=token)
    web.start()
    if config.open_ways:
        warn_each_minute(config.open_ways)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: server.drain())
    try:
        answered = server.run()
    finally:
        web.close()
    if not answered:
        abandon(config.drain_s)
    log.info("stopped; every accepted request was answered")
    return 0


def abandon(drain_s: float) -> NoReturn:
    """End the process at once: the teardown of a normal exit can crash native code that still runs."""
    text = "tasks were still running after the drain time of %g s and are abandoned; remedy: raise --drain-s"
    log.error(text, drain_s)
    logging.shutdown()
    os._exit(1)


def load_tasks(modules: Sequence[str]) -> tuple[str, ...]:
    """Import the modules of tasks and of the one that `robot-client check` runs; read what they cover."""
    from offboard.common.source.comparison import read_files_of_server
    from offboard.common.source.task_modules import load_modules
    from offboard.common.tasks import kinds

    load_modules(modules)
    if not kinds():
        raise ConfigError(f"--tasks: {','.join(modules)} registers no task")
    load_modules([EMPTY_TASK_MODULE])
    read_files_of_server()
    return (*modules, EMPTY_TASK_MODULE)


if __name__ == "__main__":
    sys.exit(main())
