"""The relay between robot and cloud: sockets, control, and record."""
