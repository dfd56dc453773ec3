"""Which site starts when, and whose answer is used."""
