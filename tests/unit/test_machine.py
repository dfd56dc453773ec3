"""What a dataset says of the machine that it was measured on."""

from pathlib import Path

from offboard.loadgen.play.machine import gpu, machine
from offboard.loadgen.play.measure_dataset import specifications, table_one
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.table.table_formats import render


def test_graphics_processors_are_found_by_their_devices(tmp_path: Path) -> None:
    """Without a device there is none; a driver that names the model gives its name."""
    assert gpu(tmp_path) == "none"
    (tmp_path / "dev/dri").mkdir(parents=True)
    for name in ("null", "dri/card0", "dri/renderD128", "kfd"):
        (tmp_path / "dev" / name).touch()
    assert gpu(tmp_path) == f"{tmp_path}/dev/dri/renderD128, {tmp_path}/dev/kfd"
    named = tmp_path / "proc/driver/nvidia/gpus/0000:01:00.0"
    named.mkdir(parents=True)
    (named / "information").write_text("Model: \t\t NVIDIA T4\nIRQ: 1\n")
    assert gpu(tmp_path) == "NVIDIA T4"


def test_table_one_names_what_robot_and_cloud_ran_on(tmp_path: Path) -> None:
    """It has a column for each, with processor, quota, memory, graphics processor and system."""
    scenario = read_scenario(find_scenario("paper"))
    lines = specifications(machine(), scenario, tmp_path)
    text = render([table_one("paper", lines)], "md").splitlines()
    assert text[0] == "Table I of paper: robot and cloud."
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text[2:]]
    assert cells[0] == ["", "robot", "cloud"]
    assert ["CPU quota", "0.2 CPU", "1 CPU"] in cells
    whats = [cell[0] for cell in cells[2:]]
    assert whats == ["processor", "cores", "CPU quota", "RAM", "GPU", "runs in", "system", "kernel", "Python"]
    assert all(all(cell) for cell in cells[2:])
    assert max(map(len, text)) <= 100
