"""`python -m benchmarks.cost_per_task FILE`: servers, bytes and money for a fleet.

FILE holds figures that `python -m benchmarks.capacity` has measured. All prices are yours: this program knows
none. The currency is that of your prices.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import Table

GIGABYTE = 1e9
HOUR_S = 3600.0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cost_per_task", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="figures of `python -m benchmarks.capacity`")
    price = parser.add_argument_group("prices")
    price.add_argument("--server-hour", type=amount, required=True, help="of one such server for an hour")
    price.add_argument("--gigabyte-out", type=amount, required=True, help="that leaves the cloud")
    price.add_argument("--gigabyte-radio", type=amount, default=0.0, help="that a robot sends or receives")
    need = parser.add_argument_group("what you need")
    need.add_argument("--rate", type=positive, default=1.0, help="tasks per second of one robot (default: 1)")
    need.add_argument(
        "--p95-ms", type=positive, required=True, help="what 95 %% of the tasks may take at most"
    )
    need.add_argument("--spare", type=count, default=1, help="servers that may be away (default: 1)")
    need.add_argument("--robots", type=counts, default="1,10,100,1000", help="default: %(default)s")
    chosen = parser.parse_args(argv)
    try:
        figures = json.loads(chosen.file.read_text())
        step = best_step(figures["steps"], chosen.p95_ms)
    except (OSError, ValueError, KeyError, TypeError) as error:
        parser.error(f"{chosen.file}: no figures of `python -m benchmarks.capacity`: {error!r}")
    if step is None:
        parser.error(f"--p95-ms: no measured rate stays within {chosen.p95_ms:g} ms")
    memory = f"{figures['memory_idle_mib']} MiB of memory at the start, {figures['memory_peak_mib']} at most"
    print(f"{figures['task']}; {figures['workers']} workers; {memory};")
    print(f"{figures['measured']}; {figures['machine']}\n")
    print(carried(figures["steps"]))
    print(fleet(step, chosen))
    return 0


def best_step(steps: Sequence[dict[str, Any]], p95_ms: float) -> dict[str, Any] | None:
    """The highest measured rate at which the server answered every task, 95 % of them in time."""
    good = [step for step in steps if step["p95_ms"] <= p95_ms and step["by_server"] == 1]
    return max(good, key=lambda step: float(step["answered_a_s"]), default=None)


def carried(steps: Sequence[dict[str, Any]]) -> Table:
    """What was measured at each rate."""
    columns = (
        *("asked/s", "answered/s", "by server", "P50 ms", "P95 ms"),
        *("CPU ms", "other CPUs", "bytes up", "bytes down"),
    )
    rows = [
        [
            f"{step['asked_a_s']:.1f}",
            f"{step['answered_a_s']:.1f}",
            f"{step['by_server']:.1%}",
            f"{step['p50_ms']:.0f}",
            f"{step['p95_ms']:.0f}",
            f"{step['cpu_s'] * 1e3:.1f}",
            f"{step['robots_cpus'] + step['others_cpus']:.1f}",
            f"{step['bytes_to_server']:.0f}",
            f"{step['bytes_to_robot']:.0f}",
        ]
        for step in steps
    ]
    return Table("Plans of one server", columns, rows)


def fleet(step: dict[str, Any], chosen: argparse.Namespace) -> Table:
    """Servers and money an hour for fleets of several sizes."""
    both = step["bytes_to_server"] + step["bytes_to_robot"]
    rows = []
    for robots in chosen.robots:
        tasks_a_s = robots * chosen.rate
        servers = math.ceil(tasks_a_s / step["answered_a_s"]) + chosen.spare
        out_gb, radio_gb = (tasks_a_s * HOUR_S * n / GIGABYTE for n in (step["bytes_to_robot"], both))
        rent, out, radio = (
            servers * chosen.server_hour,
            out_gb * chosen.gigabyte_out,
            radio_gb * chosen.gigabyte_radio,
        )
        total = rent + out + radio
        rows.append(
            [
                *(f"{robots}", f"{tasks_a_s:g}", f"{servers}", f"{radio_gb:.3g}"),
                *(f"{money:.4g}" for money in (rent, out, radio, total, total / tasks_a_s / HOUR_S * 1e6)),
            ]
        )
    columns = (
        "robots",
        "tasks/s",
        "servers",
        "GB/h",
        "servers/h",
        "egress/h",
        "radio/h",
        "all/h",
        "per million tasks",
    )
    title = f"A fleet, at {step['answered_a_s']:.1f} tasks per second of a server, and {chosen.spare} spare"
    return Table(title, columns, rows)


def amount(text: str) -> float:
    """A price: a finite number from 0."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a price from 0")
    return value


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return value


def counts(text: str) -> list[int]:
    found = [count(part) for part in text.split(",")]
    if 0 in found:
        raise argparse.ArgumentTypeError(f"{text} has a fleet without a robot")
    return found


if __name__ == "__main__":
    sys.exit(main())
