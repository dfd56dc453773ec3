"""The latency of a well-behaved robot while the server is attacked, and the cost of encryption."""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.attack_connections import IDLE
from benchmarks.attackers import ATTACKS
from benchmarks.keyring import Keys
from benchmarks.measure import Requirement, Table, each_of
from benchmarks.servers import READY_S, cloud_server, running
from benchmarks.tasks import nothing
from offboard.common.planning import planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import free_pairs
from offboard.common.planning.planner import Point, Pose, plan_path
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD

MAP = Path(__file__).parents[1] / "maps/willow-full-0.05.yaml"
MIB = 1 << 20
BLOB_MIB, MESSAGE_MIB = 64, 16
PLANS, WARM = 120, 20  # in each phase, and before the first phase
SETTLE_S, SETTLE_IDLE_S = 0.7, 15.0  # from the start of an attack to its full strength
CALLS = 200
CONNECTION_BYTES = 80_000  # at most, for an idle robot with encryption
FRAGMENTS = 1.5  # the allocator keeps more memory than is requested
PERCENT = 0.99


def tables() -> list[Table]:
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        keys = Keys(Path(folder))
        return [during_attacks(keys, PLANS, ATTACKS), _keys(keys, stack)]


@dataclass(slots=True)
class _Phase:
    """The plans of one phase: without or during an attack."""

    seconds: list[float] = field(default_factory=list)
    not_answered: int = 0  # by the cloud

    def at(self, share: float) -> float:
        return sorted(self.seconds)[int(share * (len(self.seconds) - 1))]


def during_attacks(keys: Keys, plans: int, attacks: Iterable[str]) -> Table:
    """The same plans before and during each attack.

    Each attacker has its own keys, because the server shuts out a robot that floods it.
    """
    good, attackers = keys.add("good"), {name: keys.add(f"attacker-{name}") for name in attacks}
    sizes = {
        "CLOUD_BLOB_MIB": f"{BLOB_MIB}",
        "CLOUD_MESSAGE_MIB": f"{MESSAGE_MIB}",
        "CLOUD_ROBOT_MIB_S": "64",  # the server's own default
    }
    rows, quiet, attacked = [], _Phase(), _Phase()
    with (
        cloud_server("offboard.common.planning.planner", CLOUD_KEYS=str(keys.server), **sizes) as server,
        Offloader.connect(server.endpoint, policy=CLOUD, keys=good, timeout_s=READY_S) as offload,
    ):
        plan = _plans(offload, plans)
        offload.wait_for_sites(plan_path, READY_S)
        plan(_Phase(), WARM)
        at_rest = memory(server.pid, "VmRSS")
        for name in attacks:
            before, during = _Phase(), _Phase()
            plan(before, plans)
            command = [sys.executable, "-m", "benchmarks.attackers", name]
            with running(
                [*command, server.endpoint, str(server.http_port), str(attackers[name])]
            ) as attacker:
                time.sleep(SETTLE_IDLE_S if name == "idle" else SETTLE_S)
                plan(during, plans)
                steps = attacker.communicate(timeout=READY_S)[0].strip()
            quiet.seconds += before.seconds
            attacked.seconds += during.seconds
            attacked.not_answered += during.not_answered
            ratios = [f"{during.at(share) / before.at(share):.2f}" for share in (0.5, PERCENT)]
            used_mib = f"{memory(server.pid, 'VmRSS') / MIB:.0f}"
            rows.append([name, steps, *ratios, f"{during.not_answered}", used_mib])
        most = memory(server.pid, "VmHWM")
    bound = memory_bound(at_rest)
    requirements = [
        Requirement("median during attacks, relative to before", attacked.at(0.5) / quiet.at(0.5), 1.5),
        Requirement("P99 during attacks, relative to before", attacked.at(PERCENT) / quiet.at(PERCENT), 3.0),
        Requirement("plans that the cloud did not answer", attacked.not_answered, 0),
        Requirement(
            f"memory of the server ({at_rest / MIB:.0f} MiB at rest)", most / MIB, bound / MIB, "MiB"
        ),
    ]
    columns = (
        "attack (half a core)",
        "steps",
        "median, relative to before",
        "P99, relative to before",
        "not answered",
        "server MiB",
    )
    return Table("Latency of a well-behaved robot during an attack", columns, rows, requirements)


def memory_bound(at_rest: int) -> float:
    """The memory that a server may take according to docs/security.md, with the settings used here."""
    asked = (BLOB_MIB + BLOB_MIB + MESSAGE_MIB + BLOB_MIB) * MIB + IDLE * CONNECTION_BYTES
    return at_rest + FRAGMENTS * asked


def memory(pid: int, name: str) -> int:
    """The memory of a process in bytes: VmRSS is now, VmHWM is the highest so far."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def _plans(offload: Offloader, count: int) -> Callable[[_Phase, int], None]:
    grid = read_map(MAP)
    ends = [grid.metres(pair) for pair in free_pairs(grid, count, seed=1, radius_m=planner.RADIUS_M)]
    places = [(Pose(*map(float, start)), Point(*map(float, goal))) for start, goal in ends]

    def plan(phase: _Phase, most: int) -> None:
        for pose, goal in places[:most]:
            began = time.perf_counter()
            offload(plan_path, grid, None, pose, goal)
            phase.seconds.append(time.perf_counter() - began)
            phase.not_answered += offload.last is None or offload.last.used != CLOUD

    return plan


def _keys(keys: Keys, stack: contextlib.ExitStack) -> Table:
    """The time of an empty task with and without encryption."""
    own = keys.add("measured")
    cases = {}
    for name, folder, environ in (
        ("without keys", None, {}),
        ("with keys", own, {"CLOUD_KEYS": str(keys.server)}),
    ):
        endpoint = stack.enter_context(cloud_server(**environ)).endpoint
        offload = stack.enter_context(Offloader.connect(endpoint, policy=CLOUD, keys=folder))
        offload.wait_for_sites(nothing, READY_S)
        cases[name] = lambda count, offload=offload: [offload(nothing) for _ in range(count)]
    seconds = each_of(cases, CALLS, rounds=15)
    rows = [[name, f"{each * 1e6:.0f}"] for name, each in seconds.items()]
    ratio = seconds["with keys"] / seconds["without keys"]
    requirement = Requirement("with keys, relative to without keys", ratio, 1.25)
    return Table("An empty task with encryption (CURVE)", ("server", "us"), rows, [requirement])
