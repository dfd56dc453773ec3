"""`python -m benchmarks [TABLE ...]`: measures the speed, compared to other software and to limits."""

import argparse
import importlib
import os
import platform
import sys
from importlib.metadata import version

from benchmarks.measure import processor

TABLES = (
    "planner",
    "decision",
    "lower_bounds",
    "same_decisions",
    "calls",
    "first_calls",
    "deadlines",
    "server_load",
    "hundred_robots",
    "attacks",
    "footprint",
    "page_cost",
    "shared_server",
    "stream_steps",
    "task_cost",
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "table", nargs="*", metavar="TABLE", help=f"one of {', '.join(TABLES)} (default: all)"
    )
    chosen = parser.parse_args().table or TABLES
    for name in chosen:
        if name not in TABLES:
            parser.error(f"table {name!r} is not one of {', '.join(TABLES)}")
    print(f"{processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, ", end="")
    print(", ".join(f"{package} {version(package)}" for package in ("numpy", "numba", "pyzmq")), end="\n\n")
    failed = 0
    for name in chosen:
        for table in importlib.import_module(f"benchmarks.{name}").tables():
            print(table, flush=True)
            failed += sum(not requirement.holds for requirement in table.requirements)
    print(f"requirements that fail: {failed}" if failed else "all requirements hold")
    return 0


if __name__ == "__main__":
    sys.exit(main())
