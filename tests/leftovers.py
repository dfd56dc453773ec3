"""What a process has: to be compared before and after."""

from pathlib import Path


def left() -> tuple[int, int]:
    """The threads of this process, those of libzmq among them, and its open files."""
    return sum(1 for _ in Path("/proc/self/task").iterdir()), sum(1 for _ in Path("/proc/self/fd").iterdir())
