"""`robot-client`: the commands that prepare a robot, and the planner server for ROS 2.

What a command does is in `check`, `common.security.keys` and `offboard/ros2`.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from offboard.common.command_line import Command, CommandParser, add_flags, run_commands
from offboard.common.config import resolve

ENDPOINT = "tcp://HOST:PORT of the server; dns://HOST:PORT or a sites file FILE.toml: each server there"


def main(argv: Sequence[str] | None = None) -> int:
    about = "Makes the keys of a robot, checks whether it can use a server, and plans its paths with ROS 2."
    return run_commands("robot-client", about, COMMANDS, sys.argv[1:] if argv is None else argv)


def _check(argv: Sequence[str]) -> int:
    from offboard.robot_client.check.check_config import CheckConfig

    about = "Check step by step whether this robot can use a server. Each failed step comes with a remedy."
    parser = CommandParser(prog="robot-client check", description=about, operands="ENDPOINT")
    parser.add_argument("endpoint", metavar="ENDPOINT", help=ENDPOINT)
    add_flags(parser, CheckConfig, "ROBOT_CHECK")
    flags = parser.parse_args(argv)
    config = resolve(CheckConfig, flags, environ=os.environ, prefix="ROBOT_CHECK")
    sys.path.insert(0, str(Path.cwd()))  # so that task modules here are found, as with `python -m`
    import logging

    from offboard.robot_client.check.outcome import FAIL
    from offboard.robot_client.check.steps import Check
    from offboard.robot_client.servers import read_servers

    logging.disable(logging.WARNING)  # the lines say the same
    failed = False
    servers = read_servers(flags.endpoint, config.keys)
    for server in servers:
        if len(servers) > 1:
            print(f"{server.site}: {server.endpoint}", flush=True)
        check = Check(
            server.endpoint,
            keys=config.keys,
            modules=config.tasks,
            timeout_s=config.timeout_s,
            key=server.key,
        )
        for line in check.run():
            print(line, flush=True)
            failed = failed or line.status == FAIL
    return int(failed)


def _make_keys(argv: Sequence[str]) -> int:
    from offboard.common.security.keys import ROBOT, run_keys

    run_keys(ROBOT, argv, prog="robot-client keys", prefix="ROBOT_KEYS", environ=os.environ)
    return 0


def _ros2(argv: Sequence[str]) -> int:
    from offboard.ros2.command import run_ros2

    return run_ros2(argv)


COMMANDS = {
    "check": Command("check whether this robot can use a server", _check),
    "keys": Command("make the keys of this robot", _make_keys),
    "ros2": Command("plan paths for nav2, onboard or in the cloud", _ros2),
}

if __name__ == "__main__":
    sys.exit(main())
