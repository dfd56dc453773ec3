"""Robots and policy servers that speak the openpi protocol."""
