"""Command lines of tests: flags of a test, and defaults for those that it leaves out."""

from collections.abc import Sequence


def completed(flags: Sequence[str], **defaults: str) -> list[str]:
    """The flags, and each default whose flag is not among them; a flag must not be given twice."""
    missing = [(f"--{name}", value) for name, value in defaults.items() if f"--{name}" not in flags]
    return [*flags, *(word for pair in missing for word in pair)]
