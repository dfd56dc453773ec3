"""Runs scenarios in virtual time, with the robot's own `Offloader`."""
