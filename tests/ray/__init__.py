"""Tests of `--executor ray` on real clusters; `make ray` runs them in an environment of its own."""
