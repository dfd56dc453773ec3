"""The task `plan_path`. Here are the names of its planners, without imports, for settings."""

DIJKSTRA, ASTAR, JPS = PLANNERS = ("dijkstra", "astar", "jps")


def check_planner(name: str, *, weighted: bool) -> None:
    """ValueError if there is no such planner, or if it cannot plan on weighted cells."""
    if name not in PLANNERS:
        raise ValueError(f"planner is {name!r}, allowed are {', '.join(PLANNERS)}")
    if weighted and name == JPS:
        raise ValueError(f"costs are not allowed with planner {JPS!r}, only with {DIJKSTRA} and {ASTAR}")
