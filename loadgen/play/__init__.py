"""One run: plays a scenario, checks the answers, writes the summary."""
