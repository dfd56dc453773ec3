"""`offboard client|server|bench`: the three commands under one name."""

import importlib
import sys
from collections.abc import Sequence

COMMANDS = {
    "client": ("robot_client", "run tasks on a robot, onboard or in the cloud (robot-client)"),
    "server": ("cloud_server", "run tasks for robots (cloud-server)"),
    "bench": ("loadgen", "scenarios, tables and reports (loadgen)"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Hand the rest of the command line to the chosen command; 2 if the first word is none of them."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    chosen = arguments[0] if arguments else ""
    if chosen in COMMANDS:
        command = importlib.import_module(f"offboard.{COMMANDS[chosen][0]}.__main__")
        code: int = command.main(arguments[1:])
        return code
    usage = "\n".join(f"  {name:8}{about}" for name, (_, about) in COMMANDS.items())
    text = f"usage: offboard COMMAND ...\n\n{usage}\n\n`offboard COMMAND --help` lists its flags."
    if chosen in ("-h", "--help"):
        print(text)
        return 0
    print(f"{text}\noffboard: error: {chosen!r} is not one of {', '.join(COMMANDS)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
