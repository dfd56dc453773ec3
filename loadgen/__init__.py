"""The test bench: load, network, faults, measurement. Never needed in the field."""
