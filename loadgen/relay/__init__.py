"""The relay between robot and cloud: what a link does to bytes, its sockets, and who may change it."""
