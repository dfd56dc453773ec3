"""Which servers a robot knows and uses, while lists of servers change."""
