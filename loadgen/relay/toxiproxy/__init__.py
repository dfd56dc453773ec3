"""Toxiproxy's HTTP API, so that its clients can control the relay."""
