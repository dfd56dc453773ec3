"""The model of a network link: delay, jitter, loss, bandwidth limit, outage."""
