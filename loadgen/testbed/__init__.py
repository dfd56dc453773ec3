"""What a run is played on: child processes on loopback, or containers."""
