"""Fixtures that several unit tests share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two import run_table
from tests.table_loops import Line, csv_of


@pytest.fixture
def print_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Writes a CSV dataset (text, or lines of numbers), runs `loadgen table --all` on it."""
    monkeypatch.chdir(tmp_path)

    def run(rows: str | list[Line], name: str = "twelve.csv", **settings: Any) -> str:
        text = rows if isinstance(rows, str) else csv_of(rows)
        Path(name).write_text(text, encoding="utf-8")
        assert run_table(Path(name), TableConfig(all_columns="columns" not in settings, **settings)) == 0
        return capsys.readouterr().out

    return run
