"""A task that does nothing. Every server has it, so that `robot-client check` can try any server."""

from offboard.common.tasks import task

EMPTY = "offboard_empty"


@task(EMPTY, size=lambda: 0.0)
def empty() -> None:
    """Return at once."""
