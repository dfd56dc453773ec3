"""One run with real processes: plays a scenario, verifies the answers and writes the summary."""
