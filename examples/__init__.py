"""Applications to copy: each file holds one task, its inputs, and a `main` that runs it against a server.

`docs/applications.md` explains how each of them is measured and what its link costs. This file is for
`python -m examples.NAME`: a mistake is one line and exit code 2.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from offboard import ConfigError, MissingExtra
from offboard.common.command_line import USAGE_EXIT, run_command


def missing(module: str, extra: str) -> BaseException:
    """What to raise in the module of an example, `__name__`, if its library is missing."""
    if module != "__main__":
        return MissingExtra(module, extra)
    print(MissingExtra(_program(), extra), file=sys.stderr)
    return SystemExit(USAGE_EXIT)


def run(main: Callable[[str], None]) -> NoReturn:
    """Call `main` with the server that the command line names, and end the program."""

    def call() -> int:
        if len(sys.argv) != 2:
            raise ConfigError("one argument is needed: tcp://HOST:PORT of the server")
        main(sys.argv[1])
        return 0

    sys.exit(run_command(_program(), call))


def _program() -> str:
    return f"examples.{Path(sys.argv[0]).stem}"
