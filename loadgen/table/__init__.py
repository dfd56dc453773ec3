"""Tables from measured times: Table II, replayed policies, and their confidence intervals."""
