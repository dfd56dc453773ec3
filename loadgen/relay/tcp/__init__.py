"""The relay itself: TCP connections whose bytes pass the link model, and the record of what it did."""
