"""What is recorded about each task: the trace and the metrics."""
