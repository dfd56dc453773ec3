"""The simulated robot: an application of the library that drives over a map and asks for paths."""
