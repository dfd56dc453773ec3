"""Modelled machines, links and costs, and the virtual clock."""
