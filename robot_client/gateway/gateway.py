"""`robot-client gateway`: finds the onboard policy, and serves clients until it is ended.

How clients are served is in `web_socket_gateway` and `groot_gateway`.
"""

import contextlib
import logging
import signal
import sys
import threading
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.logs import start_log
from offboard.robot_client.gateway.gateway_config import GatewayConfig
from offboard.robot_client.gateway.groot_gateway import GrootGateway
from offboard.robot_client.gateway.policy_sites import Onboard, PolicySites
from offboard.robot_client.policy_servers.converted import check_convert
from offboard.robot_client.policy_servers.groot import GROOT
from offboard.robot_client.records.recording import Recording
from offboard.robot_client.settings import Settings

FIRST_S = 2.0  # for which a client waits for a first server

log = logging.getLogger(__name__)


def run_gateway(config: GatewayConfig) -> int:
    """Serve clients until SIGTERM or Ctrl-C."""
    start_log(config.log, "text")
    onboard: Onboard | None = None
    if config.onboard is not None:
        onboard = _object("--onboard", config.onboard)
        if not callable(onboard):
            raise ConfigError(f"--onboard: {config.onboard!r} is not a function")
    convert = {site: _object(f"--convert {site}", name) for site, name in config.converts().items()}
    for site, one in convert.items():
        check_convert(f"--convert {site}", one)
    settings = Settings(insecure=config.insecure, convert=convert)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.closing(Recording(trace=config.trace, metrics=config.metrics)) as recording:
        connect = partial(_connect, config, onboard, settings=settings, recording=recording)
        if config.listen.startswith(GROOT):
            GrootGateway(config.listen, connect).serve(stop)
        else:
            from offboard.robot_client.gateway.web_socket_gateway import WebSocketGateway  # an extra

            WebSocketGateway(config.address, connect).serve(stop)
    return 0


def _connect(
    config: GatewayConfig, onboard: Onboard | None, *, settings: Settings, recording: Recording
) -> PolicySites:
    """The sites of one client."""
    sites = PolicySites(
        config.sites(),
        groot=config.listen.startswith(GROOT),
        onboard=onboard,
        quality=config.quality,
        deadline_s=config.deadline_s,
        keys=config.keys,
        settings=settings,
        observers=recording.observers,
    )
    if recording.live is not None:
        sites.offload.show_on(recording.live)
    if not sites.wait(FIRST_S):
        log.warning("no policy server is there; remedy: robot-client check")
    return sites


def _object(flag: str, name: str) -> Any:
    """What MODULE:OBJECT names; the folder in which the gateway was started is searched, too."""
    module, _, attribute = name.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{flag}: {name!r}: {error}; give MODULE:NAME") from error
