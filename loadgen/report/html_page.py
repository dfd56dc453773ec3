"""The HTML page of a report: one file without scripts, which opens offline and makes no requests.

Its charts are made fit for the page in `inline_svg.py`.
"""

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from offboard.loadgen.report.inline_svg import inline
from offboard.loadgen.table.table_formats import Table, cells

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
TERMS = {
    "d": "The input size: the number from which the time of a task is predicted. "
    "For a plan it is n ln n, divided by the number of cells of the map.",
    "N": "The window size: a prediction uses the latest N executions of a site. "
    "full: the predictor learns from the first 80 % of the rows and is tested on the others.",
    "feedback": "The sites that learn after the warm-up. chosen: only the site that ran the task. "
    "full: both sites, which a real robot could only do by running every task twice.",
    "residual": "The mean predicted time minus the mean real time: errors can cancel. "
    "MAE: the mean absolute error, in which errors cannot cancel.",
    "accuracy": "The share of tasks that were sent to the site that was really faster.",
    "oracle": "A policy that always chooses the site that is really faster. "
    "Regret is the time that another policy takes beyond it.",
    "paper": "The published policy: the cloud if its predicted time is lower, else onboard.",
}
RAISED = re.compile(r"\^(\w)")  # as in the heading t^c


@dataclass(frozen=True, slots=True)
class Panel:
    """One chart, as the content of an SVG file; None if there is no chart, for the reason in the caption.

    `png` is a picture instead of a chart.
    """

    name: str
    title: str
    caption: str
    svg: bytes | None
    png: bytes | None = None


def page(
    title: str,
    *,
    about: Sequence[str],
    facts: Mapping[str, str],
    panels: Sequence[Panel],
    tables: Sequence[Table],
) -> str:
    """The whole document. All texts are escaped here, except those inside the charts.

    `about` is shown once, at the top; it includes the notes of all tables.
    """
    said = "".join(f"<p>{escape(line)}</p>" for line in about)
    parts = [
        "<!doctype html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        '<link rel="icon" href="data:,">',
        f"<title>{escape(title)}</title>",
        f"<style>{CSS}</style>",
        "</head>",
        "<body>",
        f"<header><h1>{escape(title)}</h1>{said}</header>",
        "<main>",
        f'<dl class="facts">{_pairs(facts)}</dl>',
        '<div class="charts">',
        *map(_panel, panels),
        f"<aside><h2>Terms</h2><dl>{_pairs(TERMS)}</dl></aside>",
        "</div>",
        *(_table(table, f"table-{number}") for number, table in enumerate(tables, 1)),
        "</main>",
        "</body>",
        "</html>",
        "",
    ]
    return "\n".join(parts)


def _pairs(texts: Mapping[str, str]) -> str:
    pairs = (f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in texts.items())
    return "".join(pairs)


def _panel(panel: Panel) -> str:
    heading = f"<h2>{escape(panel.title)}</h2>"
    chart = f'<div class="chart">{inline(panel.svg, panel.name, panel.title)}</div>' if panel.svg else ""
    if panel.png:
        data = base64.b64encode(panel.png).decode()
        chart = f'<img src="data:image/png;base64,{data}" alt="{escape(panel.title)}">'
    caption = f"<figcaption>{escape(panel.caption)}</figcaption>"
    return f'<figure id="{panel.name}">{heading}{chart}{caption}</figure>'


def _table(table: Table, name: str) -> str:
    headings = "".join(f'<th scope="col">{_heading(of.markdown)}</th>' for of in table.headings.values())
    lines = "".join(map(_line, (cells(table, line) for line in table.lines)))
    return (
        f'<section id="{name}"><h2 id="{name}-caption">{escape(table.caption)}</h2>'
        f'<div class="scroll" role="region" tabindex="0" aria-labelledby="{name}-caption"><table>'
        f"<thead><tr>{headings}</tr></thead><tbody>{lines}</tbody></table></div></section>"
    )


def _heading(text: str) -> str:
    return RAISED.sub(r"<sup>\1</sup>", escape(text))


def _line(cells: Sequence[str]) -> str:
    first, *rest = map(escape, cells)
    return f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>'


CSS = """
:root { color-scheme: light dark; --page: #f6f7f9; --card: #ffffff; --text: #1c2330; --quiet: #566072;
  --line: #dfe3ea; --stripe: #f4f6f9; --font: system-ui, "Segoe UI", Roboto, Helvetica, Arial, sans-serif; }
@media (prefers-color-scheme: dark) {
  :root { --page: #12161d; --card: #1b212b; --text: #e8ecf2; --quiet: #a8b3c4; --line: #323b49;
    --stripe: #202734; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 78rem; padding: 1.5rem clamp(0.75rem, 3vw, 2rem) 3rem;
  background: var(--page); color: var(--text); font: 1rem/1.5 var(--font); overflow-wrap: anywhere; }
h1 { margin: 0; font-size: 1.5rem; line-height: 1.25; }
h2 { margin: 0 0 0.75rem; font-size: 1.05rem; }
header p { margin: 0.2rem 0 0; color: var(--quiet); font-size: 0.9rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 0.75rem;
  margin: 1.25rem 0; }
.facts div, figure, aside, section { background: var(--card); border: 1px solid var(--line);
  border-radius: 0.6rem; }
.facts div { padding: 0.6rem 0.9rem; }
.facts dt { color: var(--quiet); font-size: 0.85rem; }
.facts dd { font-size: 1.3rem; font-weight: 600; font-variant-numeric: tabular-nums; }
dl, dd { margin: 0; }
aside div { margin-top: 0.5rem; font-size: 0.9rem; }
aside dt { font-weight: 600; }
aside dd { color: var(--quiet); }
.charts { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1rem; }
figure, aside { margin: 0; padding: clamp(0.6rem, 2vw, 1rem); break-inside: avoid; }
figcaption { margin-top: 0.6rem; color: var(--quiet); font-size: 0.9rem; }
.chart { background: #ffffff; border-radius: 0.4rem; }
.chart svg { display: block; width: 100%; height: auto; }
figure img { display: block; width: 100%; height: auto; }
.chart svg * { stroke-linejoin: round; stroke-linecap: butt; }
.chart text { font-family: var(--font) !important; }
@media (max-width: 60rem) { .charts { grid-template-columns: minmax(0, 1fr); } }
section { margin-top: 1rem; padding: clamp(0.6rem, 2vw, 1rem); break-inside: avoid; }
section h2 { margin: 0 0 0.5rem; font-size: 0.95rem; }
.scroll { overflow-x: auto; }
.scroll:focus-visible { outline: 2px solid #4c8dd6; outline-offset: 2px; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums;
  white-space: nowrap; }
th, td { padding: 0.3rem 0.6rem; text-align: right; border-bottom: 1px solid var(--line); }
thead th { color: var(--quiet); font-weight: 600; vertical-align: bottom; }
th:first-child { position: sticky; left: 0; background: var(--card); text-align: left; }
tbody tr:nth-child(even) > * { background: var(--stripe); }
sup { line-height: 0; }
"""
