"""Faults and scenarios in containers need the engine that the compose tests need."""

from tests.compose.conftest import engine

__all__ = ["engine"]
