"""The door for programs that speak to a policy server: the same answers, from several servers and onboard."""
