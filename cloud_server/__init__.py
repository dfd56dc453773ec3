"""Runs tasks for robots and reports its state."""
