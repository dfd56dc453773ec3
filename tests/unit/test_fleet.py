"""Simulated fleets: the queues of the servers, figures by hand, and runs that can be repeated."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.__main__ import main
from offboard.loadgen.fleet.fleet_figures import herding, line_of
from offboard.loadgen.fleet.fleet_run import Fleet, make_tasks, run_fleet
from offboard.loadgen.fleet.fleet_servers import ASK, CANCEL, REPLY, REQUEST, Servers, ToServer
from offboard.loadgen.fleet.fleet_settings import FleetConfig, FleetSize
from offboard.loadgen.progress import progress

CONFIG = FleetConfig(robots=(60,), servers=(6,), tasks=24, start_s=4.0)
DELAY_S = 0.01


@cache
def played(config: FleetConfig = CONFIG, jobs: int = 1) -> Fleet:
    with progress("tasks") as shown:
        return run_fleet(config, config.fleets()[0], make_tasks(config), jobs=jobs, shown=shown)


def request(at_s: float, number: int, cpu_s: float, limit_s: float = 9.0) -> ToServer:
    return ToServer(at_s, REQUEST, 0, 0, number, cpu_s=cpu_s, limit_s=limit_s)


def test_a_server_runs_requests_in_order_and_drops_those_that_are_late() -> None:
    """With one worker, each waits for the ones before; one that did not begin in time is not run."""
    servers = Servers(FleetSize(robots=1, servers=1, workers=1), 1, DELAY_S)
    sent = servers.step([request(1.0, 1, 0.5), request(1.1, 2, 0.5), request(1.2, 3, 0.5, limit_s=1.9)], 9.0)
    assert [(one.number, one.sort) for one in sent] == [(1, REPLY), (2, REPLY)]
    assert [one.arrives_s for one in sent] == pytest.approx([1.51, 2.01])
    assert [one.queue_s for one in sent] == pytest.approx([0.0, 0.4])
    assert [one.queue for one in sent] == [1, 0]
    assert servers.busy_s.tolist() == pytest.approx([1.0])


def test_a_cancelled_request_leaves_the_queue() -> None:
    """Those behind it begin earlier; one that runs goes on to its end, and is not answered."""
    servers = Servers(FleetSize(robots=1, servers=1, workers=1), 1, DELAY_S)
    asked = [request(1.0, 1, 0.5), request(1.1, 2, 0.5), request(1.2, 3, 0.5)]
    cancelled = [ToServer(1.3, CANCEL, 0, 0, number) for number in (1, 2)]
    sent = servers.step(asked + cancelled, 9.0)
    assert [(one.number, one.arrives_s) for one in sent] == [(3, pytest.approx(2.01))]
    assert servers.busy_s.tolist() == pytest.approx([1.0])


def test_the_oracle_knows_the_queue_of_each_server() -> None:
    """It takes the server that ends first, or onboard if that is faster."""
    servers = Servers(FleetSize(robots=1, servers=2, workers=1), 2, DELAY_S)
    busy = [request(1.0, 1, 0.5), replace_server(request(1.0, 2, 0.2), 1)]
    asks = [
        ToServer(1.1, ASK, 0, -1, n, cpu_s=0.3, limit_s=onboard_s, ways=(0, 1))
        for n, onboard_s in enumerate((9.0, 0.3))
    ]
    servers.step(busy + asks, 9.0)
    assert servers.oracle_s[0].tolist() == pytest.approx([0.1 + 0.3 + 2 * DELAY_S, 0.3])


def replace_server(message: ToServer, server: int) -> ToServer:
    return message._replace(server=server)


def test_herding_is_told_from_the_requests_at_the_servers() -> None:
    """Servers that take turns repeat with -1; what one always has more is no herd, nor is a common change."""
    turns = np.array([[4, 0], [4, 0], [0, 4], [0, 4]] * 10, np.int32)
    uneven, repeats = herding(turns)
    assert uneven == pytest.approx(1.0)
    assert repeats == pytest.approx(-1.0)
    assert herding(turns + np.array([9, 0], np.int32))[1] == pytest.approx(-1.0)
    together = np.repeat(np.arange(40, dtype=np.int32)[:, None], 2, axis=1)
    assert herding(together) == (0.0, None)
    assert herding(turns[:4]) == (None, None)


def test_the_number_of_processes_changes_nothing() -> None:
    """Robots in two processes do what they do in one, to the last digit."""
    one, two = played(), played(jobs=2)
    assert one.done == two.done
    assert (one.oracle_s == two.oracle_s).all()
    assert (one.samples == two.samples).all()


def test_robots_learn_and_share_equal_servers() -> None:
    """After the warm-up they take little more than the oracle, and no server has twice the mean load."""
    line = line_of(played(), CONFIG.start_s, 1.0)
    assert line.tasks == 60 * 24
    assert 0 <= line.settled_ms < 0.1 * line.mean_ms
    assert line.busiest is not None
    assert line.busiest < 2
    assert line.idlest is not None
    assert line.idlest > 0.5


def test_a_mass_start_costs_regret() -> None:
    """If all robots warm up on small servers at the same time, they wait for each other."""
    small = replace(CONFIG, servers=(4,), workers_per_robot=0.07)
    spread, mass = (line_of(played(replace(small, start_s=start_s)), start_s, 1.0) for start_s in (8.0, 0.0))
    assert mass.regret_ms > 1.2 * spread.regret_ms


def test_the_command_prints_a_table_and_writes_figures_and_chart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """JSON output holds nothing else; the file has the shares of all servers, which add up."""
    flags = ["--robots", "8,12", "--servers", "2", "--tasks", "6", "--out", str(tmp_path), "--format", "json"]
    assert main(["fleet", *flags]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    assert [line["robots"] for line in table["scores"]] == [8, 12]
    fleets = json.loads((tmp_path / "fleet.json").read_text())["fleets"]
    assert [sum(one["shares"]) for one in fleets] == pytest.approx([100, 100], abs=0.01)
    assert (tmp_path / "fleet.png").read_bytes().startswith(b"\x89PNG")


def test_a_fleet_may_use_no_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Onboard alone: no server has a share, the load of the servers is undefined, and the file is JSON."""
    flags = ["--robots", "8", "--servers", "2", "--tasks", "6", "--policy", "onboard", "--out", str(tmp_path)]
    assert main(["fleet", *flags]) == 0
    assert "nan" not in capsys.readouterr().out
    (fleet,) = json.loads((tmp_path / "fleet.json").read_text(), parse_constant=pytest.fail)["fleets"]
    assert (fleet["shares"], fleet["busiest"], fleet["idlest"]) == ([0, 0], None, None)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ({"robots": (10, 100), "servers": (1, 2, 3)}, "--servers: 3 numbers for 2 of --robots"),
        ({"policy": "probe:cloud"}, "needs a server named cloud"),
        ({"known": 1}, "--known: 1 is below 2"),
    ],
)
def test_a_mistake_is_one_line(flags: dict[str, object], said: str) -> None:
    """It names the flag and what is allowed."""
    with pytest.raises(ConfigError, match=said):
        FleetConfig(**flags)  # type: ignore[arg-type]
