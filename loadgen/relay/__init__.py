"""The relay between robot and cloud: its link model, its sockets, and the APIs that control it."""
