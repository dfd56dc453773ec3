"""What is written about each task: trace and metrics."""
