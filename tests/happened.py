"""Six situations in virtual time, and what their records say: `python -m tests.happened` writes the table."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from offboard import DeadlineMissed, Record, Settings, task
from offboard.robot_client.policies.hedge import NONE_LEFT
from offboard.testing import Bench

PAGE = Path(__file__).parents[1] / "docs" / "offload.md"
BEGIN, END = "<!-- happened -->\n", "<!-- end -->"
KNOWN = 12  # calls, after which both sites are known


@task("square_in_time", size=float)
def square(number: float) -> float:
    return number * number


def hedge_won(bench: Bench) -> Record:
    bench.cloud.slow(2.0)
    return bench.offload.call(square, 1.0)[1]


def hedge_lost(bench: Bench) -> Record:
    bench.cloud.slow(0.3)
    return bench.offload.call(square, 1.0)[1]


def fallback(bench: Bench) -> Record:
    bench.clock.at(bench.clock.now_s() + 0.02, bench.cloud.gone)
    return bench.offload.call(square, 1.0)[1]


def none_left(bench: Bench) -> Record:
    while NONE_LEFT not in bench.offload.call(square, 1.0)[1].decision.reason:
        bench.cloud.slow(2.0)
        bench.offload(square, 1.0)  # its hedge takes a second run
        bench.cloud.back()
    bench.cloud.slow(1.0)
    return bench.offload.call(square, 1.0)[1]


def deadline_missed(bench: Bench) -> Record:
    bench.cloud.slow(2.0)
    try:
        bench.offload(square, 1.0, deadline_s=0.3)
    except DeadlineMissed as missed:
        return missed.record
    raise AssertionError("the call had an answer in time")


def cancelled(bench: Bench) -> Record:
    bench.cloud.slow(2.0)
    call = bench.offload.submit(square, 1.0)
    while not bench.offload.sites["cloud"].in_flight:  # its thread has begun, and no time has passed
        time.sleep(0.001)
    bench.clock.at(bench.clock.now_s() + 0.02, call.cancel)
    while not call.done():
        bench.clock.pass_by(0.01)
    record = call.record
    assert record is not None
    return record


SITUATIONS: dict[str, Callable[[Bench], Record]] = {
    "a hedge that wins": hedge_won,
    "a hedge that loses": hedge_lost,
    "a fallback": fallback,
    "no second run left": none_left,
    "a missed deadline": deadline_missed,
    "a cancelled call": cancelled,
}


def rows() -> Iterator[tuple[str, str]]:
    """Each situation, and what its record says."""
    for name, play in SITUATIONS.items():
        with Bench(onboard_s=0.4, cloud_s=0.05, settings=Settings(seed=1)) as bench:
            for number in range(KNOWN):
                bench.offload(square, float(number))
                bench.clock.pass_by(1.0)
            yield name, play(bench).happened


def table() -> str:
    lines = [f"| {name} | {said} |" for name, said in rows()]
    return "\n".join(["| situation | `record.happened` |", "| --- | --- |", *lines]) + "\n"


def main() -> None:
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}{table()}{END}{after}")


if __name__ == "__main__":
    main()
