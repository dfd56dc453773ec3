"""Which commit the running code is of; files that no measurement depends on do not count.

So measured figures, and pages about them, can be committed without making the figures old.
"""

from offboard.loadgen.play.machine import output_of

NOT_CODE = (  # as patterns of git, from the root of the checkout
    "docs",
    "tests",
    "*.md",
    "loadgen/datasets",
    "benchmarks/capacity.json",
    "benchmarks/figures",  # it runs the measurements, and writes the pages
    ".ci",
    ".gitignore",
    "Makefile",
)
_CODE = (":(top)", *(f":(top,exclude){pattern}" for pattern in NOT_CODE))


def commit_here() -> str | None:
    """The last commit that changed code in the checkout of the current folder.

    `-dirty` is added if code files were changed since then. None outside a checkout.
    """
    commit = output_of(("git", "log", "-1", "--format=%h", "--abbrev=12", "--", *_CODE))
    return commit and f"{commit}{'-dirty' if changed_code() else ''}"


def changed_code() -> list[str]:
    """The code files that differ from the last commit, new ones included, from the root of the checkout."""
    changed = output_of(("git", "status", "--porcelain", "--untracked-files=all", "--", *_CODE))
    return [line.split(maxsplit=1)[1] for line in (changed or "").splitlines()]
