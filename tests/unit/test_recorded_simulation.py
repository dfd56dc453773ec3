"""Recorded links in simulation: messages, the oracle and whole runs obey the model of the relay."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import DataError
from offboard.loadgen.play.run_digest import of_scenario
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.scenario import CloudPart, Scenario
from offboard.loadgen.scenario.scenario_file import LINKS, find_scenario, read_scenario, shipped
from offboard.loadgen.simulation.model.simulated_connection import Message, SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.task_costs import Cost, Noise, RobotTasks, SimulatedTask
from offboard.loadgen.simulation.model.true_costs import Oracle, TrueCosts
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.testing.virtual_clock import VirtualClock
from tests.mazes import warm

warm()  # compiles before the clock of any test runs
RURAL, TRAM = LINKS / "5g" / "5g-rural.csv", LINKS / "3g" / "3g-tram.csv"
BEGINS_S = 3.0
SCENARIO = """
name = "two"

[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["1000"]

[link]
delay_ms = 7
recording = "{file}"
recording_from_s = 5
on = "{on}"

[[cloud]]
name = "cloud"

[[cloud]]
name = "edge"
"""


def connection(clock: VirtualClock, **flags: object) -> SimulatedConnection:
    link: Link = LinkFlags(**flags).link.begun(BEGINS_S)  # type: ignore[arg-type]
    server = SimulatedServer(clock, CloudPart())
    return SimulatedConnection(clock, server, link, 1, on_up=lambda: None, on_lost=lambda: None)


def arrivals(clock: VirtualClock, line: SimulatedConnection, sent: Sequence[float], size: int) -> list[float]:
    """When the messages that the robot sends at these times arrive."""
    found: list[float] = []
    for number, at in enumerate(sent):
        clock.at(
            at,
            lambda n=number: line.send(Message(size, "task", n), lambda: found.append(clock.now_s())),  # type: ignore[misc]
        )
    clock.pass_by(max(sent) + 400)
    return found


def test_simulated_delays_are_those_of_the_recording() -> None:
    """Small messages over a whole 5G run, as the rule says in numpy: half the round trip, in order."""
    seconds, rtt_ms = np.loadtxt(RURAL, delimiter=",", skiprows=1).T
    sent = BEGINS_S + np.arange(0.0, seconds[-1], 0.031)
    clock = VirtualClock()
    came = arrivals(clock, connection(clock, recording=RURAL, bandwidth_mbps=0), list(sent), 8)
    now = rtt_ms[np.searchsorted(seconds, sent - BEGINS_S, side="right") - 1]
    assert came == pytest.approx(np.maximum.accumulate(sent + now / 2e3))
    for percent in (50, 95, 99):
        delays_ms = 1e3 * (np.array(came) - sent)
        found, recorded = np.percentile(delays_ms, percent), np.percentile(now / 2, percent)
        print(f"P{percent}: {found:.1f} ms, half the recorded trip {recorded:.1f}")


def test_simulated_bytes_are_those_of_the_recording() -> None:
    """A full tram link: in every 5 s as many bytes arrive as its rates say, within 3 %."""
    seconds, mbps = np.loadtxt(TRAM, delimiter=",", skiprows=1).T
    passed = np.concatenate([[0.0], np.cumsum(np.diff(seconds) * mbps[:-1] * 125_000)])
    clock = VirtualClock()
    line = connection(clock, recording=TRAM, delay_ms=0)
    size, count = 5000, int(passed[np.searchsorted(seconds, 300)] / 5000)
    came = np.array(arrivals(clock, line, [BEGINS_S] * count, size)) - BEGINS_S
    for start in np.arange(0.0, 290.0, 5.0):
        low, high = np.interp([start, start + 5.0], seconds, passed)
        found = size * np.sum((came >= start) & (came < start + 5.0))
        assert found == pytest.approx(high - low, rel=0.03, abs=size)


def test_the_oracle_knows_the_rates_to_come() -> None:
    """A task whose bytes take seconds is foreseen at the rates of those seconds, and so it happens."""
    clock = VirtualClock()
    line = connection(clock, recording=TRAM, delay_ms=10)
    task = SimulatedTask(1.0, {"onboard": 1.0, "cloud": 1.0}, bytes_out=2_000_000, bytes_in=400_000)
    costs = TrueCosts(RobotTasks([task], Cost(0.5, 0.0, sending_s=0.0), reports_work=False), Noise(1, 0.0))
    cpu = SimulatedCpu(clock, 1.0)
    oracle = Oracle(clock, cpu, costs, "robot")
    clock.pass_by(BEGINS_S)
    seconds, mbps = np.loadtxt(TRAM, delimiter=",", skiprows=1).T
    passed = np.concatenate([[0.0], np.cumsum(np.diff(seconds) * mbps[:-1] * 125_000)])
    there = np.interp(2_000_000, passed, seconds) + 0.01 + 0.5
    back = np.interp(np.interp(there, seconds, passed) + 400_000, passed, seconds) + 0.01
    assert oracle.cloud_s(0, line) == pytest.approx(back, abs=1e-3)
    assert back > 10


@pytest.mark.parametrize(
    ("name", "recording"), [("link-plans", RURAL), ("link-frames", TRAM)], ids=["5g-rural", "3g-tram"]
)
def test_a_shipped_recording_is_played(name: str, recording: Path) -> None:
    """CI plays two: the default loses no task, and all sites see the recorded link."""
    played = read_scenario(find_scenario(name)).changed(tasks=40)
    assert list(played.recorded()) == ["cloud"]
    with SimulationPool(1) as pool:
        policies = ("default", "cloud", "onboard")
        runs = pool.play([played, on_another_link(played)], {one: {"policy": one} for one in policies})
    for outcomes in runs.values():
        assert all(len(one.answered) == 40 for one in outcomes)
    recorded, plain = (np.mean([one.response_s for one in run.answered]) for run in runs["cloud"])
    assert played.recorded()["cloud"]["up"]["file"] == recording.name
    assert recorded != pytest.approx(plain, rel=0.05)


def on_another_link(scenario: Scenario) -> Scenario:
    """The same scenario without its recording."""
    return replace(scenario, link={"delay_ms": 15.0, "bandwidth_mbps": 100.0})


def test_every_scenario_of_the_recordings_can_be_read() -> None:
    """They are found by name, and play a shipped recording."""
    assert shipped(LINKS) == ("link-frames", "link-images", "link-plans", "link-stream")
    for name in shipped(LINKS):
        assert read_scenario(find_scenario(name)).recorded()["cloud"].keys() == {"up", "down"}


def test_a_recording_counts_by_its_content(tmp_path: Path) -> None:
    """A comparison that is resumed plays a run again if the recording has changed."""
    file = tmp_path / "run.csv"
    file.write_text("t_s,rtt_ms\n0,30\n")
    scenario = read_scenario(find_scenario("link-plans"))
    scenario = replace(scenario, link={"recording": file})
    before = of_scenario(scenario)
    file.write_text("t_s,rtt_ms\n0,31\n")
    assert of_scenario(scenario) != before


def test_one_of_several_servers_plays_the_recording(tmp_path: Path) -> None:
    """`on` names it; the other links keep their conditions. Paths are relative to the scenario."""
    (tmp_path / "run.csv").write_text("t_s,rtt_ms\n0,30\n9,31\n")
    file = tmp_path / "two.toml"
    file.write_text(SCENARIO.format(file="run.csv", on="edge"))
    scenario = read_scenario(file)
    assert list(scenario.recorded()) == ["edge"]
    assert scenario.recorded()["edge"]["up"]["from_s"] == 5
    assert scenario.links()["cloud"] == {"delay_ms": 7}
    file.write_text(SCENARIO.format(file="run.csv", on="moon"))
    with pytest.raises(DataError, match=r"two\.toml: link\.on: 'moon' is not one of cloud, edge"):
        read_scenario(file)
    file.write_text(SCENARIO.format(file="gone.csv", on="edge"))
    with pytest.raises(DataError, match=r"gone\.csv: No such file"):
        read_scenario(file)


def test_an_event_cannot_change_what_is_recorded(tmp_path: Path) -> None:
    """The scenario is refused when it is read, with the line of the event."""
    (tmp_path / "run.csv").write_text("t_s,rtt_ms\n0,30\n9,31\n")
    file = tmp_path / "two.toml"
    text = SCENARIO.format(file="run.csv", on="edge")
    file.write_text(f'{text}\n[[event]]\nat_s = 1\non = "cloud"\nlink = {{ delay_ms = 5 }}\n')
    read_scenario(file)
    file.write_text(f"{text}\n[[event]]\nat_s = 1\nlink = {{ delay_ms = 5 }}\n")
    with pytest.raises(DataError, match=r"two\.toml:22: link: up\.delay_ms: cannot be changed"):
        read_scenario(file)
