"""`offboard client|server|bench`: the three commands under one name."""

import importlib
import sys
from collections.abc import Sequence
from functools import partial

from offboard.common.command_line import Command, run_commands


def main(argv: Sequence[str] | None = None) -> int:
    """Hand the rest of the command line to the chosen command."""
    about = "Decides, task by task, whether a robot computes onboard or in the cloud."
    return run_commands("offboard", about, COMMANDS, sys.argv[1:] if argv is None else argv)


def _run(package: str, argv: Sequence[str]) -> int:
    code: int = importlib.import_module(f"offboard.{package}.__main__").main(argv)
    return code


COMMANDS = {
    "client": Command(
        "make the keys of a robot, check its way to a server, plan for nav2 (robot-client)",
        partial(_run, "robot_client"),
    ),
    "server": Command("run tasks for robots (cloud-server)", partial(_run, "cloud_server")),
    "bench": Command("play scenarios, make tables and reports (loadgen)", partial(_run, "loadgen")),
}

if __name__ == "__main__":
    sys.exit(main())
