"""Writes docs/api.md: every public name of `offboard` with what its docstring says first.

The file is complete enough to be read as it is. `hooks.py` puts the whole docstrings in its place when the
site is built. Call it with `python -m docs.site.reference`; a test compares the file with the code.
"""

import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import offboard
import offboard.testing

ROOT = Path(__file__).parents[2]
PAGE = Path("docs/api.md")
BLOCK = "<!-- api: {} -->"
END = "<!-- end -->"
GROUPS = {
    "Offload": ("Offloader", "CallFuture", "task", "Together", "Settings", "check_wanted"),
    "Streams": ("ActionStream", "Step"),
    "What happened": ("Record", "Decision", "Execution", "Savings", "Trace"),
    "Ask before": ("Expectation", "Forecast", "Outlook", "Prediction"),
    "Extend": ("Runner", "Predictor"),
    "Test": ("testing.Bench", "testing.ScriptedSite", "testing.ScriptedOnboard", "testing.SharedClock"),
    "Errors": (
        *("OffloadError", "ConfigError", "TaskError", "TaskFailed", "UnknownTask", "DeadlineMissed"),
        *("CloudError", "CloudTimeout", "CloudBusy", "CloudBroken", "BadValue", "Unwanted"),
        *("ProtocolError", "DataError", "MissingExtra"),
    ),
    "Version": ("__version__",),
}
# Fields of the trace that have no attribute of the same name: what tests/unit/test_api_page.py compares.
OTHER_NAMES = {
    "v": "no attribute: the version of the format",
    "features": "`sites[SITE].condition`; `work` is `amount`",
    "sites.SITE.quality": "`sites[SITE].quality.value`",
    "decision.second": "`decision.second.site`",
    "decision.second_after_s": "`decision.second.after_s`; a `Probe` has none, and 0 in the trace",
    "decision.latest_s": "`decision.latest.after_s`",
    "late.N.FIELD": "`late[N].execution.FIELD`; `id` is `late[N].id`",
}
ABOUT = """\
<!-- `python -m docs.site.reference` writes this page from the docstrings. -->

# Python reference

These are all names of `from offboard import ...`, and of `from offboard.testing import ...` ([Test](#test)).
Everything else may change without notice.
[Offload a function](offload.md) and [test your program](testing.md) show how to use them.
"""
TRACE_ABOUT = """\
## Trace and Python

`offload.last` is a [Record](#record), and each line of the [trace](formats.md#trace) holds its fields.
They have the same names in Python and in the file, except for these:

| field of the trace | attribute of the record |
| --- | --- |
"""
SETTINGS_ABOUT = """\
These options say what a robot learns with, and what it may spend. `loadgen drive`, `loadgen call` and
`robot-client ros2` have each of them as a flag, such as `--duplicates`.

| option | default | meaning |
| --- | --- | --- |
"""


def page() -> str:
    """The page as it should be."""
    lines = [ABOUT]
    for group, names in GROUPS.items():
        lines.append(f"## {group}\n")
        for name in names:
            lines += [f"### {_heading(name)}\n", *_entry(name)]
            if name == "Settings":
                lines.append(SETTINGS_ABOUT + "\n".join(_options()) + "\n")
    rows = [f"| `{field}` | {said} |" for field, said in OTHER_NAMES.items()]
    return "\n".join([*lines, TRACE_ABOUT + "\n".join(rows)]) + "\n"


def paragraph(text: str | None) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.cleandoc(text or "")).split("\n\n")[0].split())


def _heading(name: str) -> str:
    return f"`{name}`" if name.startswith("_") else name.removeprefix("testing.")


def _entry(name: str) -> Iterator[str]:
    value = attrgetter(name)(offboard)
    if isinstance(value, str):
        yield "The version of Offboard, as text.\n"
        return
    module = value.__module__.replace(".", "/") + ".py"
    home = module if name.startswith("testing.") else module.removeprefix("offboard/")
    yield f"{BLOCK.format(name)}\n"
    yield f"{paragraph(value.__doc__)}\n"
    methods = list(_methods(value))
    yield from [*methods, ""] if methods else []
    yield f"Source: [{home}](../{home})\n"
    yield f"{END}\n"


def _methods(value: Any) -> Iterator[str]:
    """The public methods and properties of a class, each with its first paragraph."""
    if not inspect.isclass(value) or issubclass(value, BaseException):
        return
    parts = [one for one in reversed(value.__mro__) if one.__module__.startswith("offboard.")]
    for name, member in {n: one for part in (*parts, value) for n, one in vars(part).items()}.items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        documented = inspect.isfunction(function) and function.__doc__
        if documented and (name == "__call__" or not name.startswith("_")):
            shown = "offload" if name == "__call__" else name
            call = "" if isinstance(member, property) else "(...)"
            yield f"- `{shown}{call}`: {paragraph(function.__doc__)}"


def _options() -> Iterator[str]:
    for field in fields(offboard.Settings):
        if said := field.metadata.get("help"):
            meaning = re.sub(r"\s+", " ", str(said)).replace("|", "\\|")
            yield f"| `{field.name}` | `{field.default}` | {meaning} |"


if __name__ == "__main__":
    (ROOT / PAGE).write_text(page(), encoding="utf-8")
    sys.exit(0)
