"""The command `cloud-server`: builds the server from its settings and runs it until it is told to stop."""

import logging
import os
import resource
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from offboard.cloud_server.config import ROBOTS, ServerConfig
from offboard.common.config import as_dict, load, run_command
from offboard.common.errors import ConfigError

DESCRIPTION = (
    "Runs tasks for robots over ZMQ; /health, /ready, /metrics, /config, /tasks and /docs over HTTP. "
    "`cloud-server keys` makes its keys."
)

SWITCH_S = 0.0005  # in which a thread that computes lets others in: a reply shall not wait for a flood

log = logging.getLogger("offboard.cloud_server")


def main() -> int:
    command = make_keys if sys.argv[1:2] == ["keys"] else serve
    return run_command("cloud-server", lambda: command(sys.argv[1:], os.environ))


def make_keys(argv: Sequence[str], environ: Mapping[str, str]) -> int:
    """`cloud-server keys`: the server's own, and the folder for those of robots."""
    from offboard.common.security.keys import SERVER, run_keys

    folder = run_keys(SERVER, argv[1:], prog="cloud-server keys", prefix="CLOUD_KEYS", environ=environ)
    robots = folder / ROBOTS
    try:
        robots.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {robots}: {error.strerror}") from error
    print(f"{robots}: the public key of every robot that is let in goes there")
    return 0


def serve(argv: Sequence[str], environ: Mapping[str, str]) -> int:
    """Serve until SIGTERM or Ctrl-C; 0 when every accepted request was answered."""
    config = load(
        ServerConfig, argv, prog="cloud-server", description=DESCRIPTION, environ=environ, prefix="CLOUD"
    )
    logging.basicConfig(level=config.log.upper(), format="%(asctime)s %(levelname)s %(message)s")
    sys.path.insert(0, str(Path.cwd()))  # as `python -m` does, so that --tasks finds the user's modules
    # Heavy libraries come after the settings are known to be right, and not for --help.
    from offboard.cloud_server.executors import EXECUTORS
    from offboard.cloud_server.http_api import HttpServer, create_app
    from offboard.cloud_server.metrics import Metrics
    from offboard.cloud_server.server import Limits, Server
    from offboard.common.security.exposure import warn_each_minute
    from offboard.common.security.keys import server_keys
    from offboard.common.security.private_files import read_token
    from offboard.common.tasks import kinds, load_modules

    sys.setswitchinterval(SWITCH_S)
    files_max = raise_file_limit()
    token = read_token(config.token_file)
    keys = server_keys(config.keys) if config.keys else None

    load_modules(config.tasks)
    if not kinds():
        raise ConfigError(f"--tasks: {','.join(config.tasks)} registers no task")
    log.info("settings: %s", as_dict(config))
    log.info("at most %d open files, one for each robot's connection", files_max)
    metrics = Metrics()
    executor = EXECUTORS[config.executor]
    server = Server(
        config.listen,
        executor(config.workers, config.tasks, config.blob_bytes_max, config.worker_memory_bytes),
        metrics,
        Limits(
            queue_max=config.queue_max,
            blob_bytes_max=config.blob_bytes_max,
            message_bytes_max=config.message_bytes_max,
            robot_bytes_per_s=config.robot_bytes_a_s,
            drain_s=config.drain_s,
        ),
        on_ready=lambda: log.info("ready: listening on %s, http://%s", server.endpoint, web.address),
        keys=keys,
        robots=config.robots_folder,
    )
    app = create_app(
        server.status,
        metrics.registry,
        as_dict(config),
        token=token,
        loopback=config.http_on_loopback,
        insecure=bool(config.open_ways),
    )
    web = HttpServer(app, config.http_address)
    web.start()
    if config.open_ways:
        warn_each_minute(config.open_ways)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: _stop(server))
    try:
        answered = server.run()
    finally:
        web.close()
    if not answered:
        log.error("tasks still ran when the drain time of %g s was over; they are abandoned", config.drain_s)
        logging.shutdown()
        os._exit(1)  # an abandoned thread cannot be stopped, and exit would wait for it
    log.info("stopped; every accepted request was answered")
    return 0


def raise_file_limit() -> int:
    """Let this process open as many files as it may; how many that is."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return most


def _stop(server: Any) -> None:
    server.drain()


if __name__ == "__main__":
    sys.exit(main())
