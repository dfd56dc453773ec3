"""Servers of Offboard: what is said to them over ZMQ."""
