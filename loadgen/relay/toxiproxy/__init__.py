"""The relay under Toxiproxy's HTTP API."""
