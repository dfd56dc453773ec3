"""The TCP relay, which applies the link model to real bytes, and the record of what the link did."""
