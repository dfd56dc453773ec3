"""What the host took of this machine."""

from pathlib import Path

import pytest

from offboard.loadgen.play.stolen_cpu_time import STAT, StolenCpuTime


def stat(user: int, idle: int, steal: int) -> str:
    return f"cpu  {user} 0 0 {idle} 7 0 0 {steal} 0 0\ncpu0 1 0 0 1 0 0 0 1 0 0\n"


def test_the_share_is_of_the_time_that_was_asked_for(tmp_path: Path) -> None:
    """Idling counts on neither side, nor does what was before."""
    file = tmp_path / "stat"
    file.write_text(stat(user=1000, idle=5000, steal=900))
    stolen = StolenCpuTime(file)
    file.write_text(stat(user=1030, idle=9000, steal=910))
    assert stolen.percent() == pytest.approx(25.0)


def test_who_asks_for_nothing_loses_nothing(tmp_path: Path) -> None:
    """No division by what did not pass."""
    file = tmp_path / "stat"
    file.write_text(stat(user=1000, idle=5000, steal=900))
    assert StolenCpuTime(file).percent() == 0.0


@pytest.mark.parametrize("text", [None, "", "cpu  1 2\n", "cpu  a b c d e f g h\n"])
def test_where_the_kernel_does_not_tell_nothing_is_known(tmp_path: Path, text: str | None) -> None:
    """Another system's file, or none."""
    file = tmp_path / "stat"
    if text is not None:
        file.write_text(text)
    assert StolenCpuTime(file).percent() is None


def test_this_machine_tells() -> None:
    """The kernel's own file is read as it is."""
    found = StolenCpuTime().percent()
    assert found is None if not STAT.exists() else 0 <= (found or 0.0) <= 100
