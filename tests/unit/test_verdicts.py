"""The verdicts on the paper's claims: their rule, what decides them, and their figures by numpy alone."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.loadgen.claims.claim import Claim, ClaimsConfig, Figure, claim
from offboard.loadgen.claims.claims import run_claims
from offboard.loadgen.claims.disturbed_claims import lasting_loads, no_correlation_and_outliers
from offboard.loadgen.claims.site_claims import r_by_site, r_by_window, slopes
from offboard.loadgen.claims.verdicts import FAILS, HOLDS, JUDGED, NOT_MEASURED, OPEN, verdicts
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.table_formats import Table
from tests.table_loops import THOUSAND, csv_of

ROOT = Path(__file__).parents[2]
DATASETS = ROOT / "loadgen" / "datasets"
Array = np.ndarray[Any, Any]


def judged(lines: list[Claim]) -> dict[int, Any]:
    """The verdict on each claim from these lines."""
    return {one.number: one for one in verdicts([Table("", {"source": "x"}, {}, lines)]).lines}


@pytest.mark.parametrize(
    ("says", "verdict"),
    [
        (["yes"], HOLDS),
        (["yes", "yes", "unclear"], HOLDS),
        (["yes", "unclear"], OPEN),
        (["yes", "no"], OPEN),
        (["no", "unclear", "unclear"], FAILS),
        (["no", "no", "yes"], FAILS),
        ([], NOT_MEASURED),
    ],
)
def test_a_claim_holds_if_more_than_half_of_its_lines_agree(says: list[str], verdict: str) -> None:
    """And it does not hold if more lines disagree than agree; lines that decide nothing are not counted."""
    ends = {"yes": (1.0, 2.0), "no": (-2.0, -1.0), "unclear": (-1.0, 1.0)}
    words = "r onboard - r cloud"
    lines = [Claim(3, words, "", 0.0, *ends[one], None, None, agrees=one) for one in says]
    other = claim(3, "another figure", Figure(1.0, 0.5, 2.0))
    assert judged([*lines, other])[3].verdict == verdict


def test_every_claim_is_decided_by_lines_that_are_printed(tmp_path: Path, capsys: Any) -> None:
    """No pattern of a verdict is left without a line, so that a line which is renamed is missed at once."""
    (tmp_path / "rows.csv").write_text(csv_of(THOUSAND))
    assert run_claims([tmp_path / "rows.csv"], ClaimsConfig(format="json")) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    printed = {(line["number"], line["claim"]) for line in table["scores"]}
    busy = [one.claim for one in lasting_loads(busy_rows(), ClaimsConfig())]
    printed |= {(6, words) for words in busy}
    printed |= {(12, "ahead of lstm"), (13, "training, lstm"), (13, "prediction, lstm")}  # without PyTorch
    for one in JUDGED:
        for pattern in (one.decided_by, *(pattern for _, pattern in one.shown)):
            assert any(re.fullmatch(pattern, words) for number, words in printed if number == one.number), (
                pattern
            )


def busy_rows() -> Rows:
    """Onboard times double in every other hundred rows; sizes and the cloud are as before."""
    random = np.random.default_rng(4)
    size = random.uniform(0, 2, 600)
    load = np.where(np.arange(600) // 100 % 2, 3.0, 1.0)
    return Rows(size, load * (0.1 + 0.1 * size), 0.25 + random.normal(0, 0.01, 600))


def test_a_load_that_lasts_is_seen_and_one_that_does_not_is_not() -> None:
    """With rows in another order, the same loads last for no neighbour, and nothing is claimed."""
    rows, order = busy_rows(), np.random.default_rng(1).permutation(600)
    found = {one.claim: one for one in lasting_loads(rows, ClaimsConfig())}
    assert (found["onboard: r of neighbouring errors"].low or 0.0) > 0.5
    assert found["accuracy %, N = 50, chosen"].ours is not None
    full, chosen = (found[f"accuracy %, N = 50, {mode}"].ours or 0.0 for mode in ("full", "chosen"))
    assert full > chosen + 10, "the site that is not chosen learns nothing of the end of its load"
    mixed = Rows(rows.size[order], rows.onboard_s[order], rows.cloud_s[order])
    assert [one.claim for one in lasting_loads(mixed, ClaimsConfig())][-1] == "with loads that last"


def test_outliers_and_sizes_without_meaning_cost_accuracy() -> None:
    """Where the times are exact lines, every point and every error is the outliers' or the shuffle's."""
    size = np.random.default_rng(2).uniform(0, 2, 400)
    rows = Rows(size, 0.05 + 0.2 * size, np.full(400, 0.25))
    found = {one.claim: one for one in no_correlation_and_outliers(rows, ClaimsConfig())}
    assert (found["sizes shuffled: accuracy points"].high or 0.0) < -20
    assert (found["2 % outliers: accuracy points"].high or 0.0) < 0


def columns(name: str) -> dict[str, Array]:
    rows = list(csv.DictReader((DATASETS / f"{name}.csv").read_text().splitlines()))
    return {key: np.array([float(row[key]) for row in rows]) for key in ("size", "onboard_s", "cloud_s")}


def chosen(of: dict[str, Array], length: int) -> tuple[Array, Array, Array]:
    """Algorithm 1 in numpy, after warm-up: both predictions, and whether the cloud was chosen."""
    windows = {site: list(range(length)) for site in ("onboard", "cloud")}
    predicted: dict[str, list[float]] = {"onboard": [], "cloud": []}
    to_cloud = []
    for at in range(length, len(of["size"])):
        for site, rows in windows.items():
            d, t = of["size"][rows], of[f"{site}_s"][rows]
            away = d - d.mean()
            slope = (away @ t) / (away @ away) if np.ptp(d) else 0.0
            predicted[site].append(float(t.mean() + slope * (of["size"][at] - d.mean())))
        to_cloud.append(predicted["cloud"][-1] < predicted["onboard"][-1])
        site = "cloud" if to_cloud[-1] else "onboard"
        windows[site] = [*windows[site][1:], at]
    return np.array(predicted["onboard"]), np.array(predicted["cloud"]), np.array(to_cloud)


def shown(number: int) -> str:
    """The cell "ours" of a claim on the page."""
    page = (ROOT / "docs" / "claims.md").read_text()
    found = re.search(rf"^\| {number} \|.*$", page, re.MULTILINE)
    assert found is not None
    return found[0].split("|")[4].strip()


def ends(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def test_five_verdicts_are_those_of_numpy() -> None:
    """r, its difference, the slopes, the residual at N = 5 and the accuracy at N = 50, of every dataset."""
    names = sorted(path.stem for path in DATASETS.glob("*.csv"))
    data = {name: columns(name) for name in names}
    r = {
        site: [float(np.corrcoef(of["size"], of[f"{site}_s"])[0, 1]) for of in data.values()]
        for site in ("cloud", "onboard")
    }
    slopes = [
        float(np.polyfit(of["size"], of["cloud_s"], 1)[0] / np.polyfit(of["size"], of["onboard_s"], 1)[0])
        for of in data.values()
    ]
    accuracies, residuals = [], []
    for of in data.values():
        _, _, to_cloud = chosen(of, 50)
        faster = of["cloud_s"][50:] < of["onboard_s"][50:]
        accuracies.append(100 * float((to_cloud == faster).mean()))
        _, p_cloud, _ = chosen(of, 5)
        residuals.append(100 * float(p_cloud.mean() / of["cloud_s"][5:].mean() - 1))
    more = [onboard - cloud for onboard, cloud in zip(r["onboard"], r["cloud"], strict=True)]
    for number, label, values in (
        (1, "r cloud", r["cloud"]),
        (1, "r onboard", r["onboard"]),
        (3, "larger by", more),
        (4, "slopes", slopes),
        (7, "cloud % at N = 5", residuals),
        (9, "% at N = 50", accuracies),
    ):
        part = next(one for one in shown(number).split("; ") if one.startswith(f"{label} "))
        low, _, high = part.removeprefix(f"{label} ").partition(" to ")
        found = float(low), float(high or low)
        assert found == pytest.approx(ends(values), rel=0.05, abs=0.005), (number, label)


def test_the_lines_about_r_and_slopes_are_those_of_numpy() -> None:
    """Of one dataset: r onboard minus r cloud, the slopes, and the mean r of short and of long windows."""
    of = columns("congested")
    rows, config = Rows(of["size"], of["onboard_s"], of["cloud_s"]), ClaimsConfig(windows=("10", "100"))

    def r(site: str, length: int) -> float:
        spans = [slice(at, at + length) for at in range(len(rows) - length + 1)]
        return float(np.mean([np.corrcoef(of["size"][at], of[f"{site}_s"][at])[0, 1] for at in spans]))

    expected = r("onboard", 1000) - r("cloud", 1000)
    assert r_by_site(rows, config).ours == pytest.approx(expected, rel=1e-9)
    for one, site in zip(r_by_window(rows, config), ("cloud", "onboard"), strict=True):
        assert one.ours == pytest.approx(r(site, 10) - r(site, 100), rel=1e-6)
    lines = [np.polyfit(of["size"], of[f"{site}_s"], 1)[0] for site in ("cloud", "onboard")]
    assert slopes(rows, config).ours == pytest.approx(lines[0] / lines[1], rel=1e-9)
