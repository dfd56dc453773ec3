"""The command `loadgen claims`: each claim of the paper next to our own figure for it."""
