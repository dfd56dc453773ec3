"""Decides where a task runs, runs it, learns, and records what happened."""
