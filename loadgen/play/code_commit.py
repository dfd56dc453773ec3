"""Which commit the running code is of; files that no measurement depends on do not count.

So measured figures, and pages about them, can be committed without making the figures old.
"""

from offboard.loadgen.play.machine import output_of

NOT_CODE = (  # as patterns of git, from the root of the checkout
    "docs",
    "tests/[!r]*",  # all but tests/ros2, which is measured
    "tests/r[!o]*",
    "*.md",
    "loadgen/datasets",
    "loadgen/scenarios",  # a measurement keeps the digest of those that it needs
    "benchmarks/capacity.json",
    "benchmarks/figures",  # it runs the measurements, and writes the pages
    ".ci",
    ".gitignore",
    "Makefile",
)
_CODE = (":(top)", *(f":(top,exclude){pattern}" for pattern in NOT_CODE))


def commit_here() -> str | None:
    """The last commit that changed code in the checkout of the current folder.

    `-dirty` is added if code files were changed since then. None if git does not tell, as outside a checkout.
    """
    commit = output_of(("git", "log", "-1", "--format=%h", "--abbrev=12", "--", *_CODE))
    changed = changed_code()
    if commit is None or changed is None:
        return None
    return f"{commit}{'-dirty' if changed else ''}"


def changed_code() -> list[str] | None:
    """The code files that differ from the last commit, new ones included, from the root of the checkout.

    None if git does not tell.
    """
    lines = output_of(("git", "status", "--porcelain", "--branch", "--untracked-files=all", "--", *_CODE))
    return None if lines is None else [line.split(maxsplit=1)[1] for line in lines.splitlines()[1:]]
