"""Speed beside peers on the same work: `make bench`. One file a table."""
