"""The command line of a process: flags from a config dataclass, help in groups, commands and exit codes."""

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from offboard.common import VERSION
from offboard.common.config import REQUIRED, flag_of, resolve, settings_of, type_of
from offboard.common.errors import ConfigError, DataError, OffloadError
from offboard.common.toml_file import nearest, unknown

C = TypeVar("C")

COLUMNS = 80  # width of the help if there is no terminal
USAGE_EXIT = 2
INTERRUPTED_EXIT, BROKEN_PIPE_EXIT = 130, 141  # 128 + the signal, as shells do it
HELP = ("-h", "--help")
SHOW_VERSION = "--version"


@dataclass(frozen=True)
class Command:
    """A sub-command: `run` gets the arguments after its name; `about` is its line in the usage."""

    about: str
    run: Callable[[Sequence[str]], int]


def run_commands(prog: str, about: str, commands: Mapping[str, Command], argv: Sequence[str]) -> int:
    """Run the sub-command that `argv` begins with, or print the version or the usage."""
    chosen = argv[0] if argv else ""
    if chosen in commands:
        return run_command(f"{prog} {chosen}", lambda: commands[chosen].run(argv[1:]))
    if chosen == SHOW_VERSION:
        print(prog, VERSION)
        return 0
    width = max(map(len, commands))
    lines = [f"  {name:<{width}}  {command.about}" for name, command in commands.items()]
    usage = [f"usage: {prog} COMMAND ...", "", about, "", *lines, ""]
    usage.append(f"`{prog} COMMAND --help` explains the flags of a command.")
    usage.append(f"`{prog} {SHOW_VERSION}` prints the version.")
    if chosen in HELP:
        print("\n".join(usage))
        return 0
    wrong = unknown("command", chosen, tuple(commands)) if chosen else "a command is missing"
    print("\n".join([*usage, "", f"{prog}: {wrong}"]), file=sys.stderr)
    return USAGE_EXIT


def run_command(prog: str, command: Callable[[], int]) -> int:
    """Return its exit code: 2 after a mistake of the user, 1 after a failed run; one line says why."""
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has closed it, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE_EXIT
    except (ConfigError, DataError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return USAGE_EXIT
    except OffloadError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return INTERRUPTED_EXIT


def load(
    cls: type[C], argv: Sequence[str], *, prog: str, description: str, environ: Mapping[str, str], prefix: str
) -> C:
    """Build `cls` from `argv`, then `PREFIX_NAME` in `environ`, then the TOML file of --config."""
    parser = CommandParser(prog=prog, description=description)
    add_flags(parser, cls, prefix)
    help = "TOML file with settings, under the names of the flags"
    parser.add_argument("--config", type=Path, metavar="FILE", help=help)
    return resolve(cls, parser.parse_args(argv), environ=environ, prefix=prefix)


class CommandParser(argparse.ArgumentParser):
    """argparse with errors of one line, and with help that hides rare flags unless --help-all is given.

    `operands` are the arguments without dashes, as the usage shows them.
    """

    def __init__(self, *, prog: str, description: str | None, operands: str = "") -> None:
        usage = " ".join(filter(None, (prog, operands, "[options]")))
        super().__init__(
            prog=prog,
            usage=usage,
            description=description,
            formatter_class=_Help,
            add_help=False,
            allow_abbrev=False,  # --task must not be taken for --tasks
        )
        self.flags: list[str] = []  # those of `add_flags`
        self._rare: dict[argparse.Action, str] = {}
        self.register("action", None, _StoreOnce)  # what a flag does unless it says otherwise
        about = "show this help, and exit"
        self._short_help = self.add_argument(*HELP, action=_ShowHelp, rare=False, help=about)
        if " " not in prog:  # of a sub-command, the command itself prints the version
            about = "print the version, and exit"
            self.add_argument(SHOW_VERSION, action="version", version=f"{prog} {VERSION}", help=about)

    def add_rare(self, action: argparse.Action) -> None:
        """Hide a flag from --help; --help-all shows it."""
        if not self._rare:
            self._short_help.help = "show the common flags, and exit"
            self.add_argument("--help-all", action=_ShowHelp, rare=True, help="show all flags, and exit")
        self._rare[action] = action.help or ""
        action.help = argparse.SUPPRESS

    def format_all(self) -> str:
        for action, help in self._rare.items():
            action.help = help
        return self.format_help()

    def error(self, message: str) -> NoReturn:
        wrong = message.partition("unrecognized arguments: ")[2].split()
        if wrong and (near := nearest(wrong[0].partition("=")[0], self.flags)):
            message = f"{message}; did you mean {near}?"
        self.exit(USAGE_EXIT, f"{self.prog}: {message} (see {self.prog} --help)\n")


def add_flags(parser: CommandParser, cls: type, prefix: str) -> None:
    """Add one flag for each setting of `cls`; the values stay text until `resolve` converts them."""
    parser.epilog = f"Each flag can also be set in the environment: --one-flag as {prefix}_ONE_FLAG."
    fields = settings_of(cls)
    common = [field.metadata["group"] for field in fields if not field.metadata["rare"]]
    titles = dict.fromkeys([*common, *(field.metadata["group"] for field in fields)])
    groups = {title: parser.add_argument_group(title) for title in titles if title != "options"}
    for field in fields:
        help = field.metadata["help"]
        if field.default is REQUIRED:
            help += " (required)"
        elif not (field.default is None or field.default is False or field.default == ()):
            values = field.default if isinstance(field.default, tuple) else (field.default,)
            help += f" (default: {','.join(map(str, values))})"
        action = groups.get(field.metadata["group"], parser).add_argument(
            f"--{flag_of(field)}", dest=field.name, help=help.replace("%", "%%"), **_shape(field, cls)
        )
        parser.flags.append(f"--{flag_of(field)}")
        if field.metadata["rare"]:
            parser.add_rare(action)


class _ShowHelp(argparse.Action):
    """Prints the help, with the `rare` flags or without, and ends the process."""

    def __init__(self, option_strings: Sequence[str], *, rare: bool, help: str, **_: Any) -> None:
        super().__init__(
            option_strings, dest=argparse.SUPPRESS, default=argparse.SUPPRESS, nargs=0, help=help
        )
        self._everything = rare

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        assert isinstance(parser, CommandParser)
        print(parser.format_all() if self._everything else parser.format_help(), end="")
        parser.exit()


class _Once(argparse.Action):
    """A flag with one value. If it is given again, that is an error: one of the values would be ignored."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, flag: Any = None
    ) -> None:
        if flag and getattr(namespace, self.dest) is not None:
            parser.error(f"{flag} is given twice, but takes one value")
        super().__call__(parser, namespace, values, flag)


class _StoreOnce(_Once, argparse._StoreAction):
    """--name VALUE"""


class _SwitchOnce(_Once, argparse.BooleanOptionalAction):
    """--name or --no-name"""


class _Help(argparse.HelpFormatter):
    """As wide as the terminal. argparse itself would import shutil, and with it three compressors, to ask."""

    def __init__(self, prog: str, **settings: Any) -> None:
        super().__init__(prog, width=_columns() - 2, **settings)


def _columns() -> int:
    given = os.environ.get("COLUMNS", "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    try:
        return os.get_terminal_size(1).columns or COLUMNS
    except OSError:  # no terminal
        return COLUMNS


def _shape(field: Any, cls: type) -> dict[str, Any]:
    """How a flag is written: --name VALUE, repeated for a list; --name or --no-name for a boolean."""
    base, many = type_of(field, cls)
    if base is bool:
        return {"action": _SwitchOnce}
    metavar = field.metadata["metavar"] or "|".join(field.metadata["choices"] or ())
    metavar = metavar or {int: "K", float: "X", Path: "FILE"}.get(base, "TEXT")
    return {"metavar": metavar, "action": "append" if many else None}
