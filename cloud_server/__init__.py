"""Runs tasks for robots and says how it is doing."""
