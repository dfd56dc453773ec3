"""Tables from measured times: Table II, replay, and their intervals."""
