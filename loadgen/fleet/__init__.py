"""Simulates a fleet: thousands of robots, each with its own `Offloader`, and the servers that they share."""
