"""A good robot that plans while another one attacks the server with all it has; and what the keys cost."""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.attackers import ATTACKS, IDLE
from benchmarks.keyring import Keys
from benchmarks.measure import Bar, Table, each_of
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
PLANS, WARM = 120, 20  # of each phase; before the first
SETTLE_S, SETTLE_IDLE_S = 0.7, 15.0  # from the start of an attack until it is under way
CALLS = 200
CONNECTION_BYTES = 80_000  # most for a robot that says nothing, its encryption counted
FRAGMENTS = 1.5  # what the allocator keeps beyond what is asked for
PERCENT = 0.99


def tables() -> list[Table]:
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        keys = Keys(Path(folder))
        return [beside(keys, PLANS, ATTACKS), _keys(keys, stack)]


@dataclass(slots=True)
class _Phase:
    seconds: list[float] = field(default_factory=list)
    lost: int = 0  # not answered by the cloud

    def at(self, share: float) -> float:
        return sorted(self.seconds)[int(share * (len(self.seconds) - 1))]


def beside(keys: Keys, plans: int, attacks: dict[str, object]) -> Table:
    """The same plans in turn alone and beside each attack, each by another robot: floods are shut out."""
    good, wicked = keys.add("good"), {name: keys.add(f"wicked-{name}") for name in attacks}
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
            before, beside = _Phase(), _Phase()
            plan(before, plans)
            command = [sys.executable, "-m", "benchmarks.attackers", name]
            with running([*command, server.endpoint, str(server.http_port), str(wicked[name])]) as attacker:
                time.sleep(SETTLE_IDLE_S if name == "idle" else SETTLE_S)
                plan(beside, plans)
                steps = attacker.communicate(timeout=READY_S)[0].strip()
            quiet.seconds += before.seconds
            attacked.seconds += beside.seconds
            attacked.lost += beside.lost
            ratios = [f"{beside.at(share) / before.at(share):.2f}" for share in (0.5, PERCENT)]
            rows.append([name, steps, *ratios, f"{beside.lost}", f"{memory(server.pid, 'VmRSS') / MIB:.0f}"])
        most = memory(server.pid, "VmHWM")
    bound = memory_bound(at_rest)
    bars = [
        Bar("median beside attacks over alone", attacked.at(0.5) / quiet.at(0.5), 1.5),
        Bar("P99 beside attacks over alone", attacked.at(PERCENT) / quiet.at(PERCENT), 3.0),
        Bar("plans that the cloud did not answer", attacked.lost, 0),
        Bar(f"memory of the server, {at_rest / MIB:.0f} MiB at rest", most / MIB, bound / MIB, " MiB"),
    ]
    columns = ("attack, by half a core", "steps", "median over alone", "P99 over alone", "lost", "server MiB")
    return Table("A good robot beside a wicked one", columns, rows, bars)


def memory_bound(at_rest: int) -> float:
    """What docs/security.md says that a server may take, with the settings used here."""
    asked = (BLOB_MIB + BLOB_MIB + MESSAGE_MIB + BLOB_MIB) * MIB + IDLE * CONNECTION_BYTES
    return at_rest + FRAGMENTS * asked


def memory(pid: int, name: str) -> int:
    """Bytes that a process takes: VmRSS, or VmHWM at most so far."""
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
            phase.lost += offload.last is None or offload.last.used != CLOUD

    return plan


def _keys(keys: Keys, stack: contextlib.ExitStack) -> Table:
    """An empty task with and without encryption."""
    own = keys.add("measured")
    cases = {}
    for name, folder, environ in (("open", None, {}), ("with keys", own, {"CLOUD_KEYS": str(keys.server)})):
        endpoint = stack.enter_context(cloud_server(**environ)).endpoint
        offload = stack.enter_context(Offloader.connect(endpoint, policy=CLOUD, keys=folder))
        offload.wait_for_sites(nothing, READY_S)
        cases[name] = lambda count, offload=offload: [offload(nothing) for _ in range(count)]
    seconds = each_of(cases, CALLS, rounds=15)
    rows = [[name, f"{each * 1e6:.0f}"] for name, each in seconds.items()]
    bar = Bar("with keys over open", seconds["with keys"] / seconds["open"], 1.25)
    return Table("An empty task by CURVE", ("way", "us"), rows, [bar])
