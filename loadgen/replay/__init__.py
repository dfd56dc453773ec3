"""Runs the tasks of a trace or dataset again in virtual time, with other policies or with that of the run."""
