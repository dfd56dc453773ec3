"""`loadgen claims`: the lines that it prints, their rule, and what it says of missing data."""

import json
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import DataError
from offboard.loadgen.__main__ import main
from offboard.loadgen.claims.claim import (
    ABOVE_ONE,
    BELOW_ONE,
    POSITIVE,
    Claimed,
    ClaimsConfig,
    Figure,
    claim,
    mean_of,
)
from offboard.loadgen.claims.claims import run_claims
from offboard.loadgen.claims.prediction_claims import RIVALS, PredictionClaims, _filled, read_inputs
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.table_formats import UNDEFINED
from tests.extras import needs
from tests.table_loops import THOUSAND, csv_of, lines_of

ROWS = THOUSAND[:300]
QUICK = ("least-squares", "parts")

PAGE = (Path(__file__).parents[2] / "docs" / "claims.md").read_text(encoding="utf-8")
SECTIONS = set(re.findall(r"^## (\d+)\. ", PAGE, re.MULTILINE))

Print = Callable[..., str]


@pytest.fixture
def print_claims(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Print:
    """Writes a CSV dataset, and runs `loadgen claims` on it."""
    monkeypatch.chdir(tmp_path)

    def run(text: str = csv_of(ROWS), predictors: tuple[str, ...] = QUICK, **settings: Any) -> str:
        Path("rows.csv").write_text(text, encoding="utf-8")
        assert run_claims([Path("rows.csv")], ClaimsConfig(predictors=predictors, **settings)) == 0
        return capsys.readouterr().out

    return run


def found_in(printed: str) -> dict[str, dict[str, Any]]:
    """The lines of a JSON output by their words."""
    (table,) = json.loads(printed)["tables"]
    return {line["claim"]: line for line in table["scores"]}


@pytest.mark.parametrize(
    ("claimed", "figure", "agrees"),
    [
        (POSITIVE, Figure(2.0, 1.0, 3.0), "yes"),
        (POSITIVE, Figure(-2.0, -3.0, -1.0), "no"),
        (POSITIVE, Figure(2.0, -1.0, 3.0), "unclear"),
        (POSITIVE, Figure(0.0158, 9.23e-18, 0.0316), "unclear"),
        (POSITIVE, Figure(-0.0158, -0.0316, 3e-15), "no"),
        (BELOW_ONE, Figure(0.9, 0.8, 1.0 - 1e-16), "unclear"),
        (ABOVE_ONE, Figure(1.1, 1.0 + 3e-16, 1.2), "unclear"),
        (POSITIVE, Figure(0.0, 0.0, 0.0), "no"),
        (POSITIVE, Figure(2.0), "unclear"),
        (POSITIVE, Figure(2.0, exact=True), "yes"),
        (BELOW_ONE, Figure(0.9, 0.8, 1.0), "unclear"),
        (BELOW_ONE, Figure(1.0, 1.0, 1.1), "no"),
        (Claimed(-2, 2), Figure(0.0, -1.9, 1.9), "yes"),
        (Claimed(-2, 2), Figure(3.0, 2.5, 3.5), "no"),
        (Claimed(-2, 2), Figure(-3.0, -3.5, -1.5), "unclear"),
    ],
)
def test_a_claim_agrees_if_the_whole_interval_does(claimed: Claimed, figure: Figure, agrees: str) -> None:
    """Yes and no need the whole interval on one side of the limits; an exact figure needs no interval."""
    assert claimed.agrees(figure) == agrees


@pytest.mark.parametrize(("values", "agrees"), [(49, "unclear"), (50, "yes")])
def test_a_few_blocks_decide_nothing(values: int, agrees: str) -> None:
    """Windows of 10 rows share rows, so a block has 10 values; below five blocks there is no interval."""
    blocks = ClaimsConfig().blocks(values, overlap=10)
    figure = mean_of(blocks, np.linspace(1.0, 2.0, values))
    assert figure.value == pytest.approx(1.5)
    assert (figure.low is None) == (figure.high is None) == (agrees == "unclear")
    assert POSITIVE.agrees(figure) == agrees


def test_every_claim_has_lines_that_fit(print_claims: Print) -> None:
    """Each section of docs/claims.md has a line, none is wider than 100, and each names a command or page."""
    printed = print_claims()
    assert {line[0] for line in lines_of(printed)} == SECTIONS - {"16"}  # 16 is k-means
    assert max(map(len, printed.splitlines())) <= 100
    assert "More of 9: loadgen table rows.csv --bootstrap" in printed
    assert all(line["more"] for line in found_in(print_claims(format="json")).values())


def test_latex_has_signs_and_words(print_claims: Print) -> None:
    """Signs are set as in mathematics, and the words between them are not."""
    printed = print_claims(format="latex", windows=("50",))
    assert r"1 & cloud: p of r, all rows & $<$ 0.005 & " in printed
    assert re.search(r"sequential - shuffled: accuracy & \$>\$ 0 & \$-[\d.]+\$ & \$-[\d.]+\$ to ", printed)


def test_figures_equal_those_of_loadgen_table(print_claims: Print, print_table: Print) -> None:
    """Accuracy, residual and mean error of N = 50 are those of Table II, and lie in their intervals."""
    claims = found_in(print_claims(format="json"))
    (table,) = json.loads(print_table(ROWS, windows=("50", "full"), format="json"))["tables"]
    fifty, full = table["scores"][:2]
    for words, expected in (
        ("accuracy %, N = 50", fifty["accuracy_percent"]),
        ("accuracy %, N = full", full["accuracy_percent"]),
        ("cloud residual %, N = 50, chosen", fifty["cloud_residual_percent"]),
        ("onboard residual %, N = 50, chosen", fifty["onboard_residual_percent"]),
        ("cloud MAE %, N = 50, chosen", 100 * fifty["cloud_mae_s"] / fifty["cloud_s"]),
        ("time / oracle, N = 50", fifty["time_over_oracle"]),
    ):
        assert claims[words]["ours"] == pytest.approx(expected, rel=1e-9), words
        assert claims[words]["low"] < claims[words]["ours"] < claims[words]["high"], words


def test_the_figures_of_the_paper_stand_next_to_ours(print_claims: Print) -> None:
    """Those that the paper prints, or that follow from what it prints."""
    claims = found_in(print_claims(format="json", windows=("50", "full")))
    assert claims["accuracy %, N = full"]["theirs"] == "83.32"
    assert claims["accuracy %, N = full"]["above"] == 83.32
    assert claims["accuracy points, N = 50 to full"]["theirs"] == "4.52"
    assert claims["onboard residual %, N = 50, full"]["theirs"] == "2.695"


@pytest.mark.parametrize("name", ["lstm", "lstm-sequence"])
def test_only_the_lstm_is_claimed_to_be_worse(name: str) -> None:
    """The paper compares least squares with an LSTM; of other predictors it gives no figure."""
    pytest.importorskip("torch", reason="torch is not installed: `make torch`")
    rows = Rows(*np.array(ROWS[:60]).T)
    claims = PredictionClaims(rows, ClaimsConfig(predictors=(name, "parts")))
    line = claims.rival(name)
    assert (line.number, line.claim, line.theirs, line.above) == (RIVALS, f"ahead of {name}", "7.64", 0.0)
    assert line.ours is not None
    assert claims.rival("parts").agrees == UNDEFINED


def test_the_same_seed_gives_the_same_lines(print_claims: Print) -> None:
    """All but the computing times; another seed moves the intervals."""

    def lines(seed: int) -> list[list[str]]:
        return [line for line in lines_of(print_claims(seed=seed)) if line[0] != "13"]

    assert lines(1) == lines(1) != lines(2)


def test_a_rule_that_halves_the_time_agrees(print_claims: Print) -> None:
    """Small tasks are faster onboard and large ones in the cloud, so choosing beats both constant rules."""
    random = np.random.default_rng(5)
    rows = [(size, 0.1 * size + 0.01, 0.2) for size in random.uniform(0, 4, 200).tolist()]
    claims = found_in(print_claims(csv_of(rows), format="json"))
    for words in ("time / always onboard, N = 50", "time / always cloud, N = 50"):
        assert claims[words]["agrees"] == "yes"
    assert claims["time / oracle, N = 50"]["ours"] == pytest.approx(1.0)
    assert claims["accuracy %, N = 50"]["agrees"] == "yes"
    assert claims["cloud MAE %, N = 50, chosen"]["ours"] == pytest.approx(0.0, abs=1e-9)


def with_load(first: int = 0) -> str:
    """A dataset whose onboard time depends on its size and on a load that is known before the task.

    The load is measured before every second task and holds for both; before task `first` it is unknown.
    """
    random = np.random.default_rng(6)
    lines = ["size,onboard_s,cloud_s,onboard.load,cloud_run_s,cloud.queue"]
    loads = random.uniform(0, 2, 100).repeat(2).tolist()
    for at, (size, load) in enumerate(zip(random.uniform(0, 2, 200).tolist(), loads, strict=True)):
        known = "" if at % 2 or at < first else repr(load)
        lines.append(f"{size!r},{0.1 + size + load!r},{1.6 + 0.1 * size!r},{known},{9 * size!r},")
    return "\n".join(lines) + "\n"


def test_several_inputs_are_used_if_the_dataset_has_them(print_claims: Print) -> None:
    """With the load, the error is that of rounding; times after the task and empty columns are no input."""
    claims = found_in(print_claims(with_load(), format="json"))
    assert claims["several inputs: accuracy points"]["note"] == "the size and onboard.load"
    assert claims["several inputs: accuracy points"]["low"] > 0
    assert claims["several inputs: onboard MAE, ratio"]["high"] < 1e-9
    assert "several inputs: cloud MAE, ratio" not in claims


def test_no_value_comes_from_the_rows_that_are_predicted(print_claims: Print) -> None:
    """Of 200 rows, 160 are learned: a load that is first known in row 158 is an input, in row 160 none."""
    assert "several inputs: accuracy points" in found_in(print_claims(with_load(158), format="json"))
    line = found_in(print_claims(with_load(160), format="json"))["several inputs"]
    assert (line["ours"], line["note"]) == (None, "only sizes are known in the first 80 % of the rows")


def test_empty_cells_before_the_first_value_hold_that_value(tmp_path: Path) -> None:
    """The others hold the last known value."""
    path = tmp_path / "rows.csv"
    path.write_text("size,onboard_s,cloud_s,onboard.load\n1,2,3,\n1,2,3,4\n1,2,3,\n1,2,3,5\n")
    read = read_inputs(path)
    assert read == {"onboard.load": [None, 4.0, None, 5.0]}
    assert _filled(read["onboard.load"]).tolist() == [4.0, 4.0, 4.0, 5.0]


def test_a_dataset_of_sizes_says_so(print_claims: Print) -> None:
    """Without further columns the line has no figure, and a note says why."""
    line = found_in(print_claims(format="json"))["several inputs"]
    assert (line["ours"], line["note"]) == (None, "only sizes are known in the first 80 % of the rows")
    assert "- 15: only sizes are known in" in print_claims()


def test_a_wrong_input_is_one_line(print_claims: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names file, line, column and value, and comes before anything is computed."""
    monkeypatch.delattr("offboard.loadgen.claims.claims.claims")
    with pytest.raises(
        DataError, match=r"^rows\.csv:2: onboard\.load: 'busy' is not a finite number from 0 to"
    ):
        print_claims("size,onboard_s,cloud_s,onboard.load\n1,2,3,busy\n" + "1,2,3,4\n" * 40)


def test_a_few_rows_are_enough_for_no_traceback(print_claims: Print) -> None:
    """Short and constant datasets print lines without figures."""
    for rows in ([(1.0, 0.1, 0.2)], [(1.0, 0.1, 0.2)] * 5, [(1.0, 0.0, 0.0)] * 60):
        assert lines_of(print_claims(csv_of(rows)))


def test_a_missing_library_is_a_note(print_claims: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other lines are printed, and a note names the extra to install."""
    monkeypatch.setitem(sys.modules, "sklearn", None)
    monkeypatch.setitem(sys.modules, "sklearn.cluster", None)
    monkeypatch.delitem(sys.modules, "offboard.loadgen.rivals.k_means", raising=False)
    claims = found_in(print_claims(predictors=("k-means", "parts"), format="json"))
    assert "needs the extra 'learned'" in claims["ahead of k-means"]["note"]
    assert claims["training, parts"]["ours"] > 0


def test_a_coarse_clock_is_a_note(print_claims: Print, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where least squares takes no time by the CPU clock, there is no multiple of it."""
    monkeypatch.setattr(time, "process_time", lambda: 1.0)
    claims = found_in(print_claims(csv_of(ROWS[:80]), format="json"))
    for words in ("training, parts", "prediction, parts"):
        assert (claims[words]["ours"], claims[words]["note"]) == (None, "the CPU clock is too coarse")


def test_several_datasets_get_a_table_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the order of the command line; every line of the CSV output names its dataset."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        Path(name).write_text(csv_of(ROWS[:80]))
    assert main(["claims", "a.csv", "b.csv", "--predictors", "parts", "--format", "csv"]) == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.startswith("source,rows,left_out,number,claim,theirs,ours,low,high,above,below,agrees")
    assert {line.partition(",")[0] for line in lines} == {"a.csv", "b.csv"}


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--windows", "1"], "--windows: '1' is neither a whole number"),
        (["--predictors", "magic"], "--predictors: 'magic' is not one of least-squares"),
        (["--format", "pdf"], "--format: 'pdf' is not one of md, csv, json, latex"),
        (["missing.csv"], "missing.csv: No such file or directory"),
    ],
)
def test_a_wrong_choice_is_one_line(
    flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistake of the user is one line on stderr and exit code 2."""
    path = tmp_path / "rows.csv"
    path.write_text(csv_of(ROWS[:80]))
    assert main(["claims", str(path), *flags]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert said in shown.err
    assert shown.err.count("\n") == 1


def test_the_rounding_error_of_a_bound_is_not_shown() -> None:
    """A bound that only the last bits keep from 0 is 0; a large one has no exponent."""
    assert claim(2, "gain", Figure(0.0158, 9.23e-18, 0.0316), claimed=POSITIVE).interval == "0 to 0.0316"
    assert claim(6, "times", Figure(1063.0, 1012.4, 1119.6)).interval == "1010 to 1120"


def test_without_scipy_the_other_claims_are_checked(
    print_claims: Print, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after `make demo`: the lines of the p-values name the extra, and all other lines are there."""
    whole = found_in(print_claims(format="json"))
    monkeypatch.setitem(sys.modules, "scipy.special", None)
    printed = print_claims(format="json")
    found = found_in(printed)
    assert found.keys() == whole.keys()
    lacking = {words for words, line in found.items() if line["ours"] is None} - {
        words for words, line in whole.items() if line["ours"] is None
    }
    p_values = {words for words in whole if "p of r" in words or "with p <" in words}
    assert lacking == {words for words in p_values if whole[words]["ours"] is not None}
    assert {found[words]["note"] for words in lacking} == {needs("the p-value of r", "learned")}
    assert needs("the p-value of r", "learned") in " ".join(print_claims().split())
