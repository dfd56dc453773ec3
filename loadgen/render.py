"""What a line of the table holds, and the table as Markdown, CSV, JSON or LaTeX.

How the figures come about is in `evaluate`.
"""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

UNDEFINED = "–"  # noqa: RUF001 (the dash for "no value" in tables)


@dataclass(frozen=True, slots=True)
class Score:
    """One line: how one window length, or one constant rule, did on the `scored` rows. None: undefined.

    First the columns of the paper's Table II, then what it leaves out (docs/evaluation.md).
    """

    window: str
    r_cloud: float | None = None
    r_onboard: float | None = None
    cloud_s: float | None = None
    cloud_predicted_s: float | None = None
    cloud_residual_s: float | None = None
    onboard_s: float | None = None
    onboard_predicted_s: float | None = None
    onboard_residual_s: float | None = None
    accuracy_percent: float | None = None
    scored: int = 0
    cloud_mae_s: float | None = None
    onboard_mae_s: float | None = None
    cloud_p95_s: float | None = None
    onboard_p95_s: float | None = None
    time_over_oracle: float | None = None
    regret_s: float | None = None
    regret_mean_s: float | None = None
    cloud_percent: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """The lines of one predictor in one feedback mode."""

    source: str
    rows: int
    left_out: int
    feedback: str
    predictor: str
    scores: tuple[Score, ...]

    @property
    def caption(self) -> str:
        left_out = f" ({self.left_out} tasks without both times left out)" if self.left_out else ""
        about = f"predictor {self.predictor}, feedback {self.feedback}"
        return f"{self.source}: {self.rows} rows{left_out}, {about}."


# Field of Score: heading in Markdown, heading in LaTeX, digits after the point.
_COLUMNS: dict[str, tuple[str, str, int]] = {
    "window": ("N", "$N$", 0),
    "r_cloud": ("r(t^c,d)", "$r(t^c,d)$", 5),
    "r_onboard": ("r(t^l,d)", "$r(t^l,d)$", 5),
    "cloud_s": ("mean t^c", r"$\bar{t}^c$", 5),
    "cloud_predicted_s": ("mean p^c", r"$\bar{p}^c$", 5),
    "cloud_residual_s": ("cloud res.", r"$\bar{p}^c-\bar{t}^c$", 5),
    "onboard_s": ("mean t^l", r"$\bar{t}^l$", 5),
    "onboard_predicted_s": ("mean p^l", r"$\bar{p}^l$", 5),
    "onboard_residual_s": ("onboard res.", r"$\bar{p}^l-\bar{t}^l$", 5),
    "accuracy_percent": ("accuracy %", r"acc. \%", 2),
    "scored": ("rows", "rows", 0),
    "cloud_mae_s": ("MAE cloud", "MAE$^c$", 5),
    "onboard_mae_s": ("MAE onboard", "MAE$^l$", 5),
    "cloud_p95_s": ("P95 cloud", "P95$^c$", 5),
    "onboard_p95_s": ("P95 onboard", "P95$^l$", 5),
    "time_over_oracle": ("time/oracle", "time/oracle", 5),
    "regret_s": ("regret s", "regret", 5),
    "regret_mean_s": ("regret s/task", "regret/task", 5),
    "cloud_percent": ("cloud %", r"cloud \%", 2),
}


def render(tables: Sequence[Table], format: str) -> str:
    """All tables as text in one of `FORMATS`."""
    return _RENDERERS[format](tables)


def _markdown(tables: Sequence[Table]) -> str:
    heading = "| " + " | ".join(markdown for markdown, _, _ in _COLUMNS.values()) + " |"
    rule = "|" + " --- |" * len(_COLUMNS)
    blocks = []
    for table in tables:
        lines = ["| " + " | ".join(_cells(score)) + " |" for score in table.scores]
        blocks.append("\n".join([table.caption, "", heading, rule, *lines, ""]))
    return "\n".join(blocks)


def _csv(tables: Sequence[Table]) -> str:
    """Full precision; every line says which table it is of; an undefined cell is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    about = ("source", "rows", "left_out", "feedback", "predictor")
    writer.writerow([*about, *(field.name for field in fields(Score))])
    for table in tables:
        for score in table.scores:
            values = ["" if value is None else value for value in asdict(score).values()]
            writer.writerow([*(getattr(table, name) for name in about), *values])
    return text.getvalue()


def _json(tables: Sequence[Table]) -> str:
    return json.dumps({"tables": [asdict(table) for table in tables]}, indent=2, ensure_ascii=False) + "\n"


def _latex(tables: Sequence[Table]) -> str:
    heading = " & ".join(latex for _, latex, _ in _COLUMNS.values()) + r" \\"
    blocks = []
    for table in tables:
        lines = [" & ".join(_latex_cell(cell) for cell in _cells(score)) + r" \\" for score in table.scores]
        top = [r"\begin{table*}", rf"\caption{{{_latex_text(table.caption)}}}"]
        body = [r"\begin{tabular}{l" + "r" * (len(_COLUMNS) - 1) + "}", r"\hline", heading, r"\hline"]
        blocks.append("\n".join([*top, *body, *lines, r"\hline", r"\end{tabular}", r"\end{table*}", ""]))
    return "\n".join(blocks)


def _cells(score: Score) -> list[str]:
    label = f"{score.window}: {score.note}" if score.note else score.window
    figures = list(_COLUMNS.items())[1:]
    return [label, *(_cell(getattr(score, name), digits) for name, (_, _, digits) in figures)]


def _cell(value: Any, digits: int) -> str:
    return UNDEFINED if value is None else f"{value:z.{digits}f}"  # z: never -0.00000


def _latex_cell(cell: str) -> str:
    if cell == UNDEFINED:
        return "--"
    return f"${cell}$" if cell.startswith("-") else _latex_text(cell)


def _latex_text(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(sign, f"\\{sign}" if sign in "&%$#_{}" else sign) for sign in text)


_RENDERERS: dict[str, Callable[[Sequence[Table]], str]] = {
    "md": _markdown,
    "csv": _csv,
    "json": _json,
    "latex": _latex,
}
FORMATS = tuple(_RENDERERS)
