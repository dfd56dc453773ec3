"""Writes a run in the formats of other tools: CSV, and MCAP with messages of ROS 2."""
