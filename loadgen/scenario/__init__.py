"""A run as data: the scenario with its events and checks, and the outcome of a run that was played."""
