"""Table II as the paper prints it, for comparison with our own figures."""

from collections.abc import Sequence
from typing import Any

from offboard.loadgen.table.table_formats import Table
from offboard.loadgen.table.table_two_figures import HEADINGS, Score

TITLE = "A Predictive Application Offloading Algorithm Using Small Datasets for Cloud Robotics"
SOURCE = f'Penmetcha, Kannan and Min, "{TITLE}", Table II'
ROWS = 1000
LSTM_PERCENT = 75.68  # accuracy of the paper's LSTM: 4 hidden layers, batch 50, 80:20 split of the same rows

_COLUMNS = (
    "r_cloud",
    "r_onboard",
    "cloud_s",
    "cloud_predicted_s",
    "cloud_residual_s",
    "onboard_s",
    "onboard_predicted_s",
    "onboard_residual_s",
    "accuracy_percent",
)
_FIGURES = {
    "5": (0.31726, 0.73545, 0.14016, 0.17697, 0.03681, 0.17527, 0.19099, 0.01572, 60.02),
    "10": (0.31717, 0.71970, 0.14029, 0.15990, 0.01961, 0.17537, 0.17888, 0.00350, 64.95),
    "20": (0.30455, 0.71198, 0.14005, 0.14595, 0.00590, 0.17546, 0.17807, 0.00260, 70.60),
    "30": (0.30245, 0.70822, 0.14005, 0.14578, 0.00573, 0.17546, 0.18259, 0.00695, 73.38),
    "40": (0.30282, 0.70922, 0.14016, 0.14056, 0.00039, 0.17552, 0.18078, 0.00525, 76.32),
    "50": (0.30273, 0.70641, 0.14025, 0.14061, 0.00036, 0.17554, 0.18027, 0.00473, 78.80),
    "75": (0.29914, 0.69775, 0.13991, 0.139972, 0.00006, 0.17519, 0.177697, 0.00250, 79.74),
    "100": (0.28395, 0.70290, 0.14048, 0.13925, -0.00123, 0.17564, 0.175838, 0.00019, 79.62),
    "500": (0.28060, 0.69707, 0.13481, 0.14012, 0.00531, 0.17113, 0.17649, 0.00536, 81.90),
    "full": (0.27761, 0.69221, 0.14011, 0.14796, 0.00785, 0.17530, 0.18151, 0.00621, 83.32),
}


def _score(window: str, figures: Sequence[float]) -> Score:
    named: dict[str, Any] = dict(zip(_COLUMNS, figures, strict=True))
    return Score("least-squares", window, **named)


SCORES = tuple(_score(window, figures) for window, figures in _FIGURES.items())


def table() -> Table:
    """The columns of the paper, under our headings."""
    return Table(
        caption=f"{SOURCE}: {ROWS} rows on the authors' machines; the paper does not name the feedback mode.",
        about={"source": SOURCE, "rows": ROWS},
        headings={name: HEADINGS[name] for name in ("window", *_COLUMNS)},
        lines=SCORES,
    )
