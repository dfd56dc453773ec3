"""Chaos tests in containers need the same Docker engine as the compose tests."""

from tests.compose.conftest import engine

__all__ = ["engine"]
