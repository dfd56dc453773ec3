"""What a run is played on: local processes, or Docker containers."""
