"""Measures every figure of the docs, and writes the pages that show them."""
