"""Applications to copy: each file holds one task, its inputs, and a `main` that runs it against a server.

`docs/applications.md` explains how each of them is measured and what its link costs.
"""
