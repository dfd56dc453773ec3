"""Scenarios without machines: the robot's own `Offloader` on a virtual clock; sites and link are modelled."""
