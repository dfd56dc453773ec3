"""`loadgen table` against plain loops, and against the twelve rows worked out in docs/evaluation.md."""

import csv
import io
import json
import math
import random
import re
import sys
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from offboard.common.errors import ConfigError, DataError, MissingExtra
from offboard.loadgen.table.table_two import PAPER_WINDOWS, TableConfig, run_table

PAGE = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
UNDEFINED = "–"  # noqa: RUF001

Line = tuple[float, float, float]  # size, onboard_s, cloud_s
Print = Callable[..., str]


class Step(NamedTuple):
    """What the plain loops found for one scored row."""

    p_onboard: float
    p_cloud: float
    cloud: bool


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Print:
    """Write a CSV (text, or lines of numbers), run the command on it, return what it printed."""
    monkeypatch.chdir(tmp_path)

    def run(rows: str | list[Line], name: str = "twelve.csv", **settings: Any) -> str:
        text = rows if isinstance(rows, str) else csv_of(rows)
        Path(name).write_text(text, encoding="utf-8")
        assert run_table(Path(name), TableConfig(**settings)) == 0
        return capsys.readouterr().out

    return run


# The paper's table in plain loops: no project code, no numpy.


def fit(window: list[tuple[float, float]], size: float) -> Any:
    """Least squares by the formula of the paper."""
    mean_d = sum(d for d, _ in window) / len(window)
    mean_t = sum(t for _, t in window) / len(window)
    sdd = sum((d - mean_d) ** 2 for d, _ in window)
    slope = sum((d - mean_d) * (t - mean_t) for d, t in window) / sdd if sdd else 0
    return slope * size + (mean_t - slope * mean_d)


def replay(rows: list[Line], first: int, length: int, feedback: str) -> list[Step]:
    """Algorithm 1 on rows `first`.. with windows of `length`; feedback "none": nothing is learnt after."""
    onboard = [(d, t) for d, t, _ in rows[:first]]
    cloud = [(d, t) for d, _, t in rows[:first]]
    steps = []
    for size, onboard_s, cloud_s in rows[first:]:
        p_onboard, p_cloud = fit(onboard, size), fit(cloud, size)
        steps.append(Step(p_onboard, p_cloud, p_cloud < p_onboard))
        if feedback == "full" or (feedback == "chosen" and p_cloud < p_onboard):
            cloud = [*cloud, (size, cloud_s)][-length:]
        if feedback == "full" or (feedback == "chosen" and not p_cloud < p_onboard):
            onboard = [*onboard, (size, onboard_s)][-length:]
    return steps


def pearson(d: list[float], t: list[float]) -> float | None:
    if min(d) == max(d) or min(t) == max(t):
        return None
    mean_d, mean_t = sum(d) / len(d), sum(t) / len(t)
    sdt = sum((x - mean_d) * (y - mean_t) for x, y in zip(d, t, strict=True))
    return sdt / math.sqrt(sum((x - mean_d) ** 2 for x in d) * sum((y - mean_t) ** 2 for y in t))


def mean_r(d: list[float], t: list[float], length: int) -> float | None:
    found = [pearson(d[at : at + length], t[at : at + length]) for at in range(len(d) - length + 1)]
    defined = [r for r in found if r is not None]
    return sum(defined) / len(defined) if defined else None


def expected_line(rows: list[Line], label: str, feedback: str) -> list[str]:
    """The printed cells of line N."""
    split = label == "full"
    length = int(0.8 * len(rows)) if split else int(label)
    steps = replay(rows, length, length, "none" if split else feedback)
    scored = rows[length:]
    count = len(scored)
    cells = [label, *(printed(r) for r in correlations(tuple(rows), len(rows) if split else length))]
    errors, percents = {}, {}
    for side, predicted in ((2, [s.p_cloud for s in steps]), (1, [s.p_onboard for s in steps])):
        true = [row[side] for row in scored]
        mean_t, mean_p = sum(true) / count, sum(predicted) / count
        cells += [printed(mean_t), printed(mean_p), printed(mean_p - mean_t)]
        percents[side] = f"{100 * (mean_p - mean_t) / mean_t:z.2f}"
        errors[side] = sorted(abs(p - t) for p, t in zip(predicted, true, strict=True))
    rank = math.ceil(Fraction(95, 100) * count)
    right, *rule = rule_cells(scored, [step.cloud for step in steps])
    cells += [right, str(count), percents[2], percents[1]]
    cells += [printed(sum(errors[side]) / count) for side in (2, 1)]
    cells += [printed(errors[side][rank - 1]) for side in (2, 1)]
    return cells + rule


@cache
def correlations(rows: tuple[Line, ...], length: int) -> list[float | None]:
    return [mean_r([row[0] for row in rows], [row[side] for row in rows], length) for side in (2, 1)]


def rule_cells(rows: list[Line], to_cloud: list[bool]) -> list[str]:
    """Accuracy, time/oracle, regret, regret a task, share of cloud."""
    spent = [
        cloud_s if cloud else onboard_s for (_, onboard_s, cloud_s), cloud in zip(rows, to_cloud, strict=True)
    ]
    best = [min(onboard_s, cloud_s) for _, onboard_s, cloud_s in rows]
    right = sum(1 for s, b in zip(spent, best, strict=True) if s == b)
    regret = sum(s - b for s, b in zip(spent, best, strict=True))
    return [
        f"{100 * right / len(rows):.2f}",
        printed(sum(spent) / sum(best)),
        printed(regret),
        printed(regret / len(rows)),
        f"{100 * sum(to_cloud) / len(rows):.2f}",
    ]


def constant_line(rows: list[Line], label: str, to_cloud: list[bool]) -> list[str]:
    mean = [printed(sum(row[side] for row in rows) / len(rows)) for side in (2, 1)]
    right, *rule = rule_cells(rows, to_cloud)
    none = [UNDEFINED, UNDEFINED]
    return [label, *none, mean[0], *none, mean[1], *none, right, str(len(rows)), *none, *none, *none, *rule]


def expected_table(rows: list[Line], labels: tuple[str, ...], feedback: str) -> list[list[str]]:
    return [
        *(expected_line(rows, label, feedback) for label in labels),
        constant_line(rows, "always-onboard", [False] * len(rows)),
        constant_line(rows, "always-cloud", [True] * len(rows)),
        constant_line(rows, "oracle", [cloud_s < onboard_s for _, onboard_s, cloud_s in rows]),
    ]


def printed(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.5f}".replace("-0.00000", "0.00000")


# Helpers that read and write text.


def csv_of(rows: list[Line]) -> str:
    return "size,onboard_s,cloud_s\n" + "".join(
        f"{d!r},{onboard!r},{cloud!r}\n" for d, onboard, cloud in rows
    )


def rows_of(text: str) -> list[Line]:
    _, *lines = csv.reader(io.StringIO(text))
    return [(float(d), float(onboard), float(cloud)) for d, onboard, cloud in lines]


def lines_of(markdown: str) -> list[list[str]]:
    """The cells of the lines below the heading of the only table in `markdown`."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def section(heading: str) -> str:
    """The text of the page below `heading`, up to the next one."""
    found = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found, f"docs/evaluation.md has no section {heading!r}"
    return found[1]


def synthetic(count: int, seed: int) -> list[Line]:
    """Times that depend on size strongly onboard and weakly in the cloud, as the paper's.

    With all their digits: a total of times of 6 places often lies halfway between two printed ones.
    """
    g = random.Random(seed)
    rows = []
    for _ in range(count):
        d = g.uniform(0, 5)
        onboard_s = max(0.01, 0.10 + 0.03 * d + g.gauss(0, 0.045))
        rows.append((d, onboard_s, 0.11 + 0.012 * d + g.expovariate(1 / 0.045)))
    return rows


THOUSAND = synthetic(1000, seed=7)
TWELVE = re.search(r"```csv\n(.*?)```", PAGE, re.DOTALL)[1]  # type: ignore[index]


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_every_column_equals_plain_loops(table: Print, feedback: str) -> None:
    """Every printed digit, for every N of the paper and full, equals an independent computation."""
    found = lines_of(table(THOUSAND, feedback=feedback))
    assert found == expected_table(THOUSAND, PAPER_WINDOWS, feedback)


def test_worked_example_is_what_is_printed(table: Print) -> None:
    """docs/evaluation.md shows exactly what the command prints for its twelve rows."""
    out = table(TWELVE, windows=("3", "full"), feedback="both")
    _, _, shown = section("What is printed").partition("feedback both`\n")
    assert shown.strip() == out.strip()


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_worked_example_equals_exact_arithmetic(feedback: str) -> None:
    """The printed tables and every step of the page equal fractions worked out by plain loops."""
    rows = [tuple(Fraction(cell) for cell in row) for row in rows_of(TWELVE)]
    steps = replay(rows, 3, 3, feedback)  # type: ignore[arg-type]
    lines = lines_of(section(f"Feedback {feedback}, row by row"))
    assert len(lines) == len(steps) == 9
    for at, (line, step) in enumerate(zip(lines, steps, strict=True), 3):
        size, onboard_s, cloud_s = rows[at]
        spent, best = (cloud_s if step.cloud else onboard_s), min(onboard_s, cloud_s)
        assert [int(line[0]), *map(Fraction, line[1:2] + line[4:6])] == [
            at + 1,
            size,
            step.p_onboard,
            step.p_cloud,
        ]
        assert line[6] == ("cloud" if step.cloud else "onboard")
        assert list(map(Fraction, line[7:9])) == [onboard_s, cloud_s]
        assert line[9:] == ["yes" if spent == best else "no", str(spent - best)]


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_worked_example_windows_are_right(feedback: str) -> None:
    """The windows that the page shows predict what the page says, and each drops its oldest observation."""
    rows = rows_of(TWELVE)
    lines = lines_of(section(f"Feedback {feedback}, row by row"))
    shown = [
        [[(float(d), float(t)) for d, t in re.findall(r"\((\d),(\d)\)", cell)] for cell in line[2:4]]
        for line in lines
    ]
    for line, windows in zip(lines, shown, strict=True):
        predicted = [fit(window, float(line[1])) for window in windows]
        assert predicted == pytest.approx([float(line[4]), float(line[5])])
    for at, (line, (before, after)) in enumerate(zip(lines, pairwise(shown), strict=False), 3):
        for side, site in enumerate(("onboard", "cloud")):
            moved = feedback == "full" or line[6] == site
            seen = (rows[at][0], rows[at][1 + side])
            assert after[side] == ([*before[side][1:], seen] if moved else before[side])


def test_worked_example_correlations_are_right() -> None:
    """Each window's r on the page is what plain loops find, and undefined where they find none."""
    rows = rows_of(TWELVE)
    for at, line in enumerate(lines_of(section("Correlations"))):
        assert line[0] == f"{at + 1}-{at + 3}"
        for side, cell in ((2, line[3]), (1, line[6])):
            r = pearson([row[0] for row in rows[at : at + 3]], [row[side] for row in rows[at : at + 3]])
            shown = cell.split("= ")[-1]
            assert shown == "undefined" if r is None else float(shown) == pytest.approx(r, abs=5e-6)


def test_stale_window_shows_in_chosen_only(table: Print) -> None:
    """A cloud slow in warm-up and fast ever after is never tried again with chosen, soon with full."""
    rows = [(1.0 + i % 2, 5.0, 9.0 if i < 2 else 1.0) for i in range(10)]
    chosen, full = (lines_of(table(rows, windows=("2",), feedback=mode))[0] for mode in ("chosen", "full"))
    # Columns: cloud residual, accuracy, regret, cloud share; full first sees a fast cloud after rows 3 and 4.
    assert [chosen[i] for i in (5, 9, 18, 20)] == ["8.00000", "0.00", "32.00000", "0.00"]
    assert [full[i] for i in (5, 9, 18, 20)] == ["2.00000", "75.00", "8.00000", "75.00"]


def test_overestimates_stay_with_chosen_feedback(table: Print) -> None:
    """The shape of Table II at N = 5: residuals lean up with chosen feedback, and stay near 0 with full."""
    out = json.loads(table(THOUSAND, windows=("5",), feedback="both", format="json"))
    chosen, full = (one["scores"][0] for one in out["tables"])
    for residual in ("cloud_residual_s", "onboard_residual_s"):
        assert chosen[residual] > 5 * abs(full[residual])


def test_both_prints_one_table_a_mode(table: Print) -> None:
    """Each caption names its file, its number of rows and its feedback mode."""
    captions = [
        line for line in table(TWELVE, windows=("3",), feedback="both").splitlines() if "feedback" in line
    ]
    assert captions == [
        f"twelve.csv: 12 rows, predictor least-squares, feedback {mode}." for mode in ("chosen", "full")
    ]


def test_default_is_chosen_and_the_windows_of_the_paper(table: Print) -> None:
    """Without flags there is one table, of chosen feedback, with the lines of Table II."""
    (one,) = json.loads(table(THOUSAND, format="json"))["tables"]
    assert one["feedback"] == "chosen"
    labels = [score["window"] for score in one["scores"]]
    assert labels == [
        *["5", "10", "20", "30", "40", "50", "75", "100", "500", "full"],
        "always-onboard",
        "always-cloud",
        "oracle",
    ]


def test_window_without_rows_to_score_says_so(table: Print) -> None:
    """N rows leave nothing to score with N of them, something with N - 1; the table goes on."""
    lines = lines_of(table(TWELVE, windows=("11", "12", "500")))
    assert lines[0][0] == "11"
    assert lines[0][10] == "1"
    assert [line[0] for line in lines[1:3]] == ["12: not enough rows", "500: not enough rows"]
    assert set(lines[1][1:]) == {UNDEFINED, "0"}


@pytest.mark.parametrize("count", [1, 2])
def test_tiny_tables_have_no_full_line(table: Print, count: int) -> None:
    """Two rows cannot be split into two to learn and one to score; the constant lines still stand."""
    lines = lines_of(table([(1.0, 2.0, 1.0)] * count, windows=("full",)))
    assert lines[0][0] == "full: not enough rows"
    assert lines[1] == constant_line([(1.0, 2.0, 1.0)] * count, "always-onboard", [False] * count)


def test_constant_columns_have_no_correlation(table: Print) -> None:
    """Equal sizes, or equal times that a rounded mean would miss, give an undefined r; null in JSON."""
    equal_sizes = [(3.0, 0.1 * i, 0.2) for i in range(1, 8)]
    assert lines_of(table(equal_sizes, windows=("3", "full")))[0][1:3] == [UNDEFINED, UNDEFINED]
    equal_times = [(float(i), 0.1, 0.1 * i) for i in range(1, 8)]
    assert lines_of(table(equal_times, windows=("3", "full")))[1][1:3] == ["1.00000", UNDEFINED]
    (one,) = json.loads(table(equal_times, windows=("3",), format="json"))["tables"]
    assert one["scores"][0]["r_onboard"] is None


@pytest.mark.parametrize(("offset", "step"), [(1e12, 1.0), (9e14, 0.125)])
def test_correlation_survives_large_offsets(table: Print, offset: float, step: float) -> None:
    """r keeps every printed digit where huge sizes differ by little, down to the last bit of a float."""
    rows = [(offset + step * (i % 3), onboard, cloud) for i, (_, onboard, cloud) in enumerate(THOUSAND[:50])]
    exact = [tuple(Fraction(value) for value in row) for row in rows]
    found = lines_of(table(rows, windows=("20",)))[0]
    assert found[1:3] == [printed(r) for r in correlations(tuple(exact), 20)]


def test_correlation_in_blocks_is_the_same(table: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound on memory does not change a figure."""
    whole = table(THOUSAND[:100], windows=("5", "30"))
    monkeypatch.setattr("offboard.loadgen.table.score.BLOCK_CELLS_MAX", 64)
    assert table(THOUSAND[:100], windows=("5", "30")) == whole


def test_tie_of_predictions_stays_onboard(table: Print) -> None:
    """Equal predictions send nothing to the cloud, and do not move its window."""
    rows = [(1.0, 2.0, 2.0)] * 3 + [(1.0, 2.0, 1.0)] * 5
    line = lines_of(table(rows, windows=("3",)))[0]
    assert (line[4], line[7], line[20]) == ("2.00000", "2.00000", "0.00")


def test_oracle_of_no_time_has_no_ratio(table: Print) -> None:
    """Where the oracle takes no time at all, time/oracle is undefined and regret is not."""
    lines = lines_of(table([(1.0, 2.0, 0.0), (2.0, 2.0, 0.0), (3.0, 0.0, 2.0)], windows=()))
    assert [line[17:19] for line in lines] == [
        [UNDEFINED, cell] for cell in ("4.00000", "2.00000", "0.00000")
    ]


def test_extreme_values_do_not_break_the_table(table: Print) -> None:
    """The largest and smallest values allowed give a table without a warning, and finite figures."""
    rows = [(1e15 * (i % 3) / 2, 1e15 / (i + 1), 5e-324 * i) for i in range(12)]
    (one,) = json.loads(table(rows, windows=("3", "full"), format="json"))["tables"]
    assert all(math.isfinite(x) for score in one["scores"] for x in score.values() if isinstance(x, float))


@pytest.mark.parametrize("window", ["1", "0", "-5", "x", "", "5.0", "1000001", "9" * 5000])
def test_bad_window_names_value_and_what_is_allowed(window: str) -> None:
    """A window is a whole number from 2 on, or full."""
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
def test_bad_setting_names_the_known_ones(settings: dict[str, Any], expected: str) -> None:
    """A feedback mode, format or predictor that does not exist is refused with the list of those that do."""
    with pytest.raises(ConfigError, match=expected):
        TableConfig(**settings)


def test_bad_file_prints_nothing(table: Print, capsys: pytest.CaptureFixture[str]) -> None:
    """A text cell ends the command before anything is on stdout."""
    with pytest.raises(DataError, match=r"bad\.csv:3: cloud_s: 'slow' is not a finite number"):
        table("size,onboard_s,cloud_s\n1,2,3\n1,2,slow\n", name="bad.csv")
    assert capsys.readouterr().out == ""


def test_several_predictors_share_a_table(table: Print) -> None:
    """A column names the predictor; the rules that predict nothing come once, at the end."""
    names = ("least-squares", "theil-sen")
    lines = lines_of(table(TWELVE, windows=("3", "full"), predictors=names))
    assert [tuple(line[:2]) for line in lines] == [
        *((name, window) for name in names for window in ("3", "full")),
        *(("", rule) for rule in ("always-onboard", "always-cloud", "oracle")),
    ]
    alone = lines_of(table(TWELVE, windows=("3", "full")))
    assert [line[1:] for line in lines[:2]] == alone[:2]


def test_slow_predictors_are_fitted_once_unless_told(table: Print) -> None:
    """The forest has a line for full only, the same in both modes; --every-window gives it every N."""
    rows, settings = THOUSAND[:60], {"windows": ("50", "full"), "predictors": ("random-forest",)}
    out = json.loads(table(rows, feedback="both", format="json", **settings))
    chosen, full = (one["scores"] for one in out["tables"])
    assert [score["window"] for score in chosen[:2]] == ["full", "always-onboard"]
    assert chosen[0] == full[0]
    every = lines_of(table(rows, every_window=True, **settings))
    assert [line[0] for line in every[:2]] == ["50", "full"]


def test_a_missing_library_is_named(table: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for by name it is an error that names the extra; among all it has a line that does."""
    monkeypatch.setitem(sys.modules, "sklearn", None)
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    monkeypatch.delitem(sys.modules, "offboard.robot_client.predictors.random_forest", raising=False)
    with pytest.raises(MissingExtra, match=r"random-forest needs the extra 'learned'"):
        table(TWELVE, windows=("full",), predictors=("random-forest",))
    monkeypatch.setattr("offboard.robot_client.predictors.names", lambda: ("least-squares", "random-forest"))
    lines = lines_of(table(TWELVE, windows=("full",), predictors=("all",)))
    assert lines[0][:2] == ["least-squares", "full"]
    assert lines[1][0].startswith("random-forest: predictor random-forest needs the extra 'learned'")


def test_intervals_hold_their_figures(table: Print) -> None:
    """--bootstrap: two lines under each, and each figure lies between them, whatever the blocks."""
    out = json.loads(table(THOUSAND, windows=("50",), bootstrap=True, format="json"))
    line, low, high = out["tables"][0]["scores"][:3]
    assert [one["bound"] for one in (line, low, high)] == ["", "2.5 %", "97.5 %"]
    figures = [name for name, value in line.items() if isinstance(value, float)]
    assert len(figures) == 19
    for name in figures:
        assert low[name] < line[name] < high[name], name
    assert lines_of(table(THOUSAND, windows=("50",), bootstrap=True))[1][:2] == ["50", "2.5 %"]
    wider = json.loads(table(THOUSAND, windows=("50",), bootstrap=True, block=100, format="json"))
    assert wider["tables"][0]["scores"][0] == line
