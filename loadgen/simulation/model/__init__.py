"""Models of computers, links and task costs, and the virtual clock."""
