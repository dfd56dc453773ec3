"""Keys, tokens, private files, and bounded HTTP connections."""
