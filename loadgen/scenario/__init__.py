"""A run as data: scenario, timeline, checks, and what came of it."""
