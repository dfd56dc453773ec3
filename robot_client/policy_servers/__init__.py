"""Policy servers that speak the openpi protocol: they answer an observation with an action."""
