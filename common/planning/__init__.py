"""The task `plan_path`: maps, search, and the compiled loops."""
