"""`robot-client`: the commands that prepare a robot, and the planner server for ROS 2.

What a command does is in `check`, `common.security.keys` and `offboard/ros2`.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from offboard.common.command_line import Command, CommandParser, add_flags, run_commands
from offboard.common.config import check, resolve, setting

if TYPE_CHECKING:
    from offboard.robot_client.check.steps import Line
    from offboard.robot_client.discovery.roster import Server

ENDPOINT = (
    "tcp://HOST:PORT of the server; dns://HOST:PORT or a sites file FILE.toml: each server there; "
    "ws://, wss:// or groot://HOST:PORT: a policy server"
)


@dataclass(frozen=True)
class CheckConfig:
    """How a server is checked."""

    keys: Path | None = setting(
        None,
        "folder with robot.key_secret and server.key, as for `Offloader.connect(keys=...)`",
        metavar="DIR",
    )
    tasks: tuple[str, ...] = setting(
        (),
        "modules whose tasks must be the same on the server (default: the planner, if both sides have it)",
        metavar="MODULE,MODULE",
    )
    observation: Path | None = setting(
        None, "one observation for a policy server, saved by np.savez", metavar="FILE.npz"
    )
    site: str = setting("server", "the site whose token is in the folder of --keys, for a policy server")
    timeout_s: float = setting(
        5.0, "time that each step may take, in seconds", name="timeout", minimum=0.1, maximum=3600
    )

    def __post_init__(self) -> None:
        check(self)


def main(argv: Sequence[str] | None = None) -> int:
    about = "Makes the keys of a robot, checks whether it can use a server, and plans its paths with ROS 2."
    return run_commands("robot-client", about, COMMANDS, sys.argv[1:] if argv is None else argv)


def _check(argv: Sequence[str]) -> int:
    about = "Check step by step whether this robot can use a server. Each failed step comes with a remedy."
    parser = CommandParser(prog="robot-client check", description=about, operands="ENDPOINT")
    parser.add_argument("endpoint", metavar="ENDPOINT", help=ENDPOINT)
    add_flags(parser, CheckConfig, "ROBOT_CHECK")
    flags = parser.parse_args(argv)
    config = resolve(CheckConfig, flags, environ=os.environ, prefix="ROBOT_CHECK")
    sys.path.insert(0, str(Path.cwd()))  # so that task modules here are found, as with `python -m`
    import logging

    from offboard.robot_client.check.steps import FAIL
    from offboard.robot_client.discovery.roster import Server
    from offboard.robot_client.servers import read_servers
    from offboard.robot_client.sites.endpoint import check_policy_server, is_policy_server

    logging.disable(logging.WARNING)  # the lines say the same
    if is_policy_server(flags.endpoint):
        check_policy_server("ENDPOINT", flags.endpoint, insecure=True)
        servers = [Server(config.site, flags.endpoint)]
    else:
        servers = read_servers(flags.endpoint, config.keys)
    failed = False
    for server in servers:
        if len(servers) > 1:
            print(f"{server.site}: {server.endpoint}", flush=True)
        steps = _policy_check if is_policy_server(server.endpoint) else _server_check
        for line in steps(server, config):
            print(line, flush=True)
            failed = failed or line.status == FAIL
    return int(failed)


def _server_check(server: "Server", config: CheckConfig) -> "Iterator[Line]":
    from offboard.robot_client.check.steps import Check

    return Check(
        server.endpoint,
        keys=config.keys,
        modules=config.tasks,
        timeout_s=config.timeout_s,
        key=server.key,
    ).run()


def _policy_check(server: "Server", config: CheckConfig) -> "Iterator[Line]":
    from offboard.common.security.keys import policy_token
    from offboard.robot_client.check.policy_steps import PolicyCheck

    return PolicyCheck(
        server.endpoint,
        token=server.token or policy_token(config.keys, server.site),
        observation=config.observation,
        timeout_s=config.timeout_s,
    ).run()


def _gateway(argv: Sequence[str]) -> int:
    from offboard.robot_client.gateway.gateway_config import GatewayConfig

    about = (
        "Stand in front of policy servers: an unchanged client connects here, and the server that should be "
        "sooner answers each observation, or onboard does."
    )
    parser = CommandParser(prog="robot-client gateway", description=about)
    add_flags(parser, GatewayConfig, "ROBOT_GATEWAY")
    flags = parser.parse_args(argv)
    config = resolve(GatewayConfig, flags, environ=os.environ, prefix="ROBOT_GATEWAY")
    from offboard.robot_client.gateway.gateway import run_gateway  # its library is an extra

    return run_gateway(config)


def _make_keys(argv: Sequence[str]) -> int:
    from offboard.common.security.keys import ROBOT, run_keys

    run_keys(ROBOT, argv, prog="robot-client keys", prefix="ROBOT_KEYS", environ=os.environ)
    return 0


def _ros2(argv: Sequence[str]) -> int:
    from offboard.ros2.command import run_ros2

    return run_ros2(argv)


COMMANDS = {
    "check": Command("check whether this robot can use a server", _check),
    "gateway": Command("answer clients of a policy server from several servers, or onboard", _gateway),
    "keys": Command("make the keys of this robot", _make_keys),
    "ros2": Command("plan paths for nav2, onboard or in the cloud", _ros2),
}

if __name__ == "__main__":
    sys.exit(main())
