"""Charts and pages of a run."""
