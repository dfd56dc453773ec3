"""What counts as the source of a task: its normal form, covered files, and how two sides differ."""
