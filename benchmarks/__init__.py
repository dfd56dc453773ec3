"""Speed compared to other software and to limits: `make bench`. One file for each table."""
