"""Many runs: the same scenario with several policies and seeds."""
