"""Tests of `--executor ray`, most of them on real clusters; `make ray` runs them."""
