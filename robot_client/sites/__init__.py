"""Where a task can run, and what is measured there."""
