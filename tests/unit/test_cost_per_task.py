"""Servers and money for a fleet, computed from measured figures and the reader's prices."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.cost_per_task import main

PRICES = ("--server-hour", "0.5", "--gigabyte-out", "0.25", "--gigabyte-radio", "2")
STEP = {
    "by_server": 1,
    "p50_ms": 20,
    "cpu_s": 0.02,
    "robots_cpus": 0.5,
    "others_cpus": 0.1,
    "bytes_to_server": 2_000,
    "bytes_to_robot": 18_000,
}


def step(rate: float, p95_ms: float, **changed: float) -> dict[str, Any]:
    return STEP | {"asked_a_s": rate, "answered_a_s": rate, "p95_ms": p95_ms} | changed


@pytest.fixture
def figures(tmp_path: Path) -> Path:
    path = tmp_path / "figures.json"
    steps = [step(10, 50), step(20, 90), step(30, 400), step(40, 80, by_server=0.9)]
    texts = {"task": "t", "measured": "m", "machine": "c"}
    memory = {"memory_idle_mib": 1, "memory_peak_mib": 2}
    path.write_text(json.dumps({**texts, **memory, "workers": 2, "steps": steps}))
    return path


def rows(text: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]


def test_servers_and_money_follow_from_figures_and_prices(
    figures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The highest rate that is fast enough counts; servers are rounded up, and one is spare."""
    assert main([str(figures), *PRICES, "--p95-ms", "100", "--rate", "0.5", "--robots", "100"]) == 0
    (found,) = rows(capsys.readouterr().out)[-1:]
    # 50 tasks/s at 20 a server: 3 and 1 spare; 180,000 tasks/h of 20 kB each, of which 18 kB leave the cloud.
    money = [4 * 0.5, 3.24 * 0.25, 3.6 * 2]
    expected = [100, 50, 4, 3.6, *money, sum(money), sum(money) / 0.18]
    assert [float(cell) for cell in found] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "--server-hour, --gigabyte-out, --p95-ms"),
        ((*PRICES, "--p95-ms", "10"), "no measured rate stays within 10 ms"),
        ((*PRICES, "--p95-ms", "0"), "0 is not above 0"),
        ((*PRICES, "--p95-ms", "100", "--robots", "0"), "without a robot"),
        (("--server-hour", "-1", "--gigabyte-out", "0", "--p95-ms", "100"), "not a price"),
    ],
)
def test_wrong_flags_end_with_one_line(
    flags: tuple[str, ...], said: str, figures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Prices have no default; a wrong value ends with exit code 2 and its reason."""
    with pytest.raises(SystemExit, match="2"):
        main([str(figures), *flags])
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "[]", '{"steps": [{}]}'])
def test_a_file_without_figures_is_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file that holds no figures ends with exit code 2, and its name."""
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(SystemExit, match="2"):
        main([str(path), *PRICES, "--p95-ms", "100"])
    assert "other.json: no figures" in capsys.readouterr().err
