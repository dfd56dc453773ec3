"""`loadgen export`: writes a run as a CSV dataset, or as an MCAP file with messages of ROS 2."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen.play.run_files import find_source
from offboard.loadgen.replay.dataset_file import measured_tasks, read_recorded, write_dataset
from offboard.loadgen.table.measured_rows import read


@dataclass(frozen=True)
class ExportConfig:
    """What is exported, and to which file; either `csv` or `mcap`."""

    csv: Path | None = setting(
        None,
        "CSV file to write: the tasks that ran on both sites, with size, times, their parts, bytes, work and "
        "features; an existing file is replaced",
    )
    kind: str | None = setting(None, "with --csv: kind of task to export, if the trace holds several kinds")
    mcap: Path | None = setting(
        None,
        "MCAP file to write, for Foxglove, Rerun and `ros2 bag`: map, scans, poses, goals, paths, decisions, "
        "and predicted and true times of a robot on a map, as messages of ROS 2; it must not exist yet "
        "(needs the extra 'mcap')",
    )

    def __post_init__(self) -> None:
        check(self)
        if (self.csv is None) == (self.mcap is None):
            raise ConfigError(f"--csv: give {'either ' * (self.csv is not None)}--csv FILE or --mcap FILE")
        if self.mcap is not None and self.kind is not None:
            raise ConfigError(f"--kind: {self.kind!r} works only with --csv")


def run_export(path: Path, config: ExportConfig) -> int:
    """Write one file about the run in a folder, or about its trace, and say what is in it."""
    if config.csv is not None:
        return _export_csv(find_source(path), config.csv, config.kind)
    assert config.mcap is not None, "checked by the config"
    return _export_mcap(path, config.mcap)


def _export_csv(source: Path, csv: Path, kind: str | None) -> int:
    rows = read(source, kind)
    write_dataset(csv, measured_tasks(read_recorded(source, kind)))
    _say(csv, f"{len(rows)} rows", rows.left_out, "without both times")
    return 0


def _export_mcap(path: Path, mcap: Path) -> int:
    if mcap.exists():
        raise ConfigError(f"--mcap: {mcap} exists; remove it, or give another file")
    from offboard.loadgen.export.mcap_file import new_mcap, write_recording  # says if the extra is missing
    from offboard.loadgen.export.recording import read_recording

    recording = read_recording(find_source(path))
    with new_mcap(mcap) as file:
        write_recording(file, recording)
    _say(
        mcap,
        f"{len(recording.tasks)} tasks, {file.count} messages",
        recording.left_out,
        "with a missing line",
    )
    return 0


def _say(written: Path, content: str, left_out: int, why: str) -> None:
    rest = f", {left_out} tasks {why} left out" if left_out else ""
    print(f"written: {written} ({content}{rest})")
