"""What the settings of `loadgen table` do to its output, and which are refused."""

import json
import sys
from collections.abc import Callable
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError, MissingExtra
from offboard.loadgen import rivals
from offboard.loadgen.table.table_settings import TableConfig
from tests.table_loops import THOUSAND, TWELVE, lines_of

Print = Callable[..., str]


@pytest.mark.parametrize("window", ["1", "0", "-5", "x", "", "5.0", "1000001", "9" * 5000])
def test_a_wrong_window_is_refused(window: str) -> None:
    """A window must be a whole number of at least 2, or full; the error names the value and both."""
    with pytest.raises(
        ConfigError, match=r"--windows: '.*' is neither a whole number from 2 to 1000000 nor full"
    ):
        TableConfig(windows=("5", window))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"feedback": "some"}, "--feedback: 'some' is not one of chosen, full, both"),
        ({"format": "pdf"}, "--format: 'pdf' is not one of md, csv, json, latex"),
        ({"predictors": ("magic",)}, "--predictors: 'magic' is not one of least-squares"),
    ],
)
def test_an_unknown_setting_is_refused_with_the_known_ones(settings: dict[str, Any], expected: str) -> None:
    """An unknown feedback mode, format or predictor is refused with a list of the known ones."""
    with pytest.raises(ConfigError, match=expected):
        TableConfig(**settings)


def test_both_prints_one_table_for_each_feedback_mode(print_table: Print) -> None:
    """Each caption names the file, the number of rows, the predictor and the feedback mode."""
    captions = [
        line
        for line in print_table(TWELVE, windows=("3",), feedback="both").splitlines()
        if "feedback" in line
    ]
    assert captions == [
        f"twelve.csv: 12 rows, predictor least-squares, feedback {mode}." for mode in ("chosen", "full")
    ]


def test_the_default_is_chosen_feedback_and_the_windows_of_the_paper(print_table: Print) -> None:
    """Without flags there is one table with chosen feedback, and with the lines of Table II."""
    (one,) = json.loads(print_table(THOUSAND, format="json"))["tables"]
    assert one["feedback"] == "chosen"
    labels = [score["window"] for score in one["scores"]]
    assert labels == [
        *["5", "10", "20", "30", "40", "50", "75", "100", "500", "full"],
        "always-onboard",
        "always-cloud",
        "oracle",
    ]


def test_slow_predictors_are_fitted_once_by_default(print_table: Print) -> None:
    """The random forest has a line for full only, the same in both modes; --every-window adds the other N."""
    rows, settings = THOUSAND[:60], {"windows": ("50", "full"), "predictors": ("random-forest",)}
    out = json.loads(print_table(rows, feedback="both", format="json", **settings))
    chosen, full = (one["scores"] for one in out["tables"])
    assert [score["window"] for score in chosen[:2]] == ["full", "always-onboard"]
    assert chosen[0] == full[0]
    every = lines_of(print_table(rows, every_window=True, **settings))
    assert [line[0] for line in every[:2]] == ["50", "full"]


def test_a_missing_library_is_named(print_table: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """A predictor with a missing library is an error that names the extra.

    With `all` it is a line that does.
    """
    monkeypatch.setitem(sys.modules, "sklearn", None)
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    monkeypatch.delitem(sys.modules, "offboard.loadgen.rivals.random_forest", raising=False)
    with pytest.raises(MissingExtra, match=r"random-forest needs the extra 'learned'"):
        print_table(TWELVE, windows=("full",), predictors=("random-forest",))
    monkeypatch.setattr(rivals, "PREDICTORS", ("least-squares", "random-forest"))
    lines = lines_of(print_table(TWELVE, windows=("full",), predictors=("all",)))
    assert lines[0][:2] == ["least-squares", "full"]
    assert lines[1][0].startswith("random-forest: predictor random-forest needs the extra 'learned'")


def test_several_predictors_share_one_table(print_table: Print) -> None:
    """With several predictors a column names them, and the constant rules come once, at the end."""
    names = ("least-squares", "parts")
    lines = lines_of(print_table(TWELVE, windows=("3", "full"), predictors=names))
    assert [tuple(line[:2]) for line in lines] == [
        *((name, window) for name in names for window in ("3", "full")),
        *(("", rule) for rule in ("always-onboard", "always-cloud", "oracle")),
    ]
    alone = lines_of(print_table(TWELVE, windows=("3", "full")))
    assert [line[1:] for line in lines[:2]] == alone[:2]


def test_each_interval_contains_its_figure(print_table: Print) -> None:
    """--bootstrap adds the two bounds below each line, the figure lies between them, and --block keeps it."""
    out = json.loads(print_table(THOUSAND, windows=("50",), bootstrap=True, format="json"))
    line, low, high = out["tables"][0]["scores"][:3]
    assert [one["bound"] for one in (line, low, high)] == ["", "2.5 %", "97.5 %"]
    figures = [name for name, value in line.items() if isinstance(value, float)]
    assert len(figures) == 19
    for name in figures:
        assert low[name] < line[name] < high[name], name
    assert lines_of(print_table(THOUSAND, windows=("50",), bootstrap=True))[1][:2] == ["50", "2.5 %"]
    wider = json.loads(print_table(THOUSAND, windows=("50",), bootstrap=True, block=100, format="json"))
    assert wider["tables"][0]["scores"][0] == line


def test_a_wrong_file_prints_nothing(print_table: Print, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong cell ends the command before anything is printed to stdout."""
    with pytest.raises(DataError, match=r"bad\.csv:3: cloud_s: 'slow' is not a finite number"):
        print_table("size,onboard_s,cloud_s\n1,2,3\n1,2,slow\n", name="bad.csv")
    assert capsys.readouterr().out == ""
