"""`loadgen fleet`: simulates fleets of different sizes, and prints a table and draws a chart of them."""

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from offboard.common.config import as_dict
from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.security.plain_files import replace_file
from offboard.loadgen.fleet.fleet_figures import LAG_S, FleetLine, line_of
from offboard.loadgen.fleet.fleet_run import Fleet, make_tasks, run_fleet
from offboard.loadgen.fleet.fleet_settings import HEADINGS, FleetConfig
from offboard.loadgen.progress import progress
from offboard.loadgen.table.table_formats import MARKDOWN, Table

FIGURES, CHART = "fleet.json", "fleet.png"
CAPTION = "Robots that share servers; times from when a task is due to its answer, in simulation:"
NOTES = (
    "regret: beyond the best site that the robot uses; settled: in the second half of its tasks",
    "busiest, idlest: the used time of a server over the mean of all servers",
    "uneven: spread of the servers' requests at one moment, over their mean",
    f"repeats: how much of that is left after {LAG_S:g} s, from -1 to 1; below 0, robots herd",
)


def run_fleets(config: FleetConfig) -> int:
    """Simulate every fleet, then print the table and write the files."""
    jobs = config.jobs or os.cpu_count() or 1
    tasks, lines, shares = make_tasks(config), list[FleetLine](), list[list[float]]()
    for size in config.fleets():
        what = f"{size.robots} robots, {size.servers} servers"
        began_s = time.monotonic()
        with progress(what, size.robots * config.tasks) as shown:
            fleet = run_fleet(config, size, tasks, jobs=jobs, shown=shown)
        lines.append(line_of(fleet, config.start_s, time.monotonic() - began_s))
        shares.append(_shares(fleet))
    table = Table(CAPTION, {"command": "fleet"}, HEADINGS, lines, notes=NOTES)
    print(config.text([table]), end="")
    _write(config.out, config, lines, shares)
    return 0


def _shares(fleet: Fleet) -> list[float]:
    """The share of each server in the time that all servers were used, in percent; 0 if none was used."""
    found: list[float] = (100 * fleet.busy_s / (fleet.busy_s.sum() or 1.0)).round(3).tolist()
    return found


def _write(
    out: Path, config: FleetConfig, lines: Sequence[FleetLine], shares: Sequence[Sequence[float]]
) -> None:
    fleets = [{**asdict(line), "shares": share} for line, share in zip(lines, shares, strict=True)]
    text = json.dumps({"settings": as_dict(config), "fleets": fleets}, indent=2, allow_nan=False)
    try:
        out.mkdir(parents=True, exist_ok=True)
        replace_file(out / FIGURES, text.encode())
        written = [out / FIGURES]
        try:
            from offboard.loadgen.fleet.fleet_chart import draw  # only now: matplotlib takes long to import

            replace_file(out / CHART, draw(lines).png)
            written.append(out / CHART)
        except MissingExtra as missing:
            _say(config, f"no chart: {missing}")
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written to: {error.strerror}") from error
    _say(config, f"written: {' and '.join(map(str, written))}")


def _say(config: FleetConfig, text: str) -> None:
    """Output for machines holds the table only."""
    if config.format == MARKDOWN:
        print(text)
