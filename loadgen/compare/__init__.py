"""Comparing policies: many runs, real or simulated, and one table for each scenario."""
