"""The share of CPU time that the host took from this virtual machine."""

from pathlib import Path

import pytest

from offboard.loadgen.play.machine import STAT, StolenCpuTime


def stat(user: int, idle: int, steal: int) -> str:
    return f"cpu  {user} 0 0 {idle} 7 0 0 {steal} 0 0\ncpu0 1 0 0 1 0 0 0 1 0 0\n"


def test_the_share_counts_only_cpu_time_that_was_asked_for(tmp_path: Path) -> None:
    """Idle time does not count, nor does time before the measurement began."""
    file = tmp_path / "stat"
    file.write_text(stat(user=1000, idle=5000, steal=900))
    stolen = StolenCpuTime(file)
    file.write_text(stat(user=1030, idle=9000, steal=910))
    assert stolen.percent() == pytest.approx(25.0)


def test_an_idle_machine_loses_nothing(tmp_path: Path) -> None:
    """If no CPU time was asked for, the share is 0 and not a division by zero."""
    file = tmp_path / "stat"
    file.write_text(stat(user=1000, idle=5000, steal=900))
    assert StolenCpuTime(file).percent() == 0.0


@pytest.mark.parametrize("text", [None, "", "cpu  1 2\n", "cpu  a b c d e f g h\n"])
def test_without_a_readable_file_the_share_is_unknown(tmp_path: Path, text: str | None) -> None:
    """A missing file, or one in another format, gives None."""
    file = tmp_path / "stat"
    if text is not None:
        file.write_text(text)
    assert StolenCpuTime(file).percent() is None


def test_the_file_of_this_machine_is_read() -> None:
    """The kernel's own file can be read."""
    found = StolenCpuTime().percent()
    assert found is None if not STAT.exists() else 0 <= (found or 0.0) <= 100
