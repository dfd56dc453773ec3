"""The names of the planners, without what it takes to run one."""

DIJKSTRA, ASTAR, JPS = PLANNERS = ("dijkstra", "astar", "jps")


def check_planner(name: str, weighted: bool) -> None:
    """ValueError where there is no such planner, or none on weighted cells."""
    if name not in PLANNERS:
        raise ValueError(f"planner is {name!r}, allowed are {', '.join(PLANNERS)}")
    if weighted and name == JPS:
        raise ValueError(f"costs are not allowed with planner {JPS!r}, only with {DIJKSTRA} and {ASTAR}")
