"""The HTML page of a report: one file, which opens offline and makes no requests.

It has the look of the page `/live`. If there are tasks to show, its top is that page: the sections, and the
scripts with the tasks inside. What they show is said by `common/live`.
"""

import base64
import gzip
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

from offboard.common.live.live_files import charts_file, page_file
from offboard.common.live.look import Look, as_json
from offboard.loadgen.play.watch import recorded_look
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
MODULES = ("memory", "answers", "charts", "stream", "live")  # each imports only from those before it
LOOK_MAX = 3_000_000  # characters of the packed tasks; the whole file stays below 6 MB
RAISED = re.compile(r"\^(\w)")  # as in the heading t^c


@dataclass(frozen=True, slots=True)
class Panel:
    """One chart or map, as the content of an SVG or PNG file; None: the caption says why there is none.

    Its id on the page is `picture-NAME`: the live page has charts of its own.
    """

    name: str
    title: str
    caption: str
    picture: bytes | None


@dataclass(frozen=True, slots=True)
class LivePart:
    """What goes into `<main>`, what goes to the end of `<body>`, and which scripts may run."""

    main: str
    scripts: str
    policy: str


def page(
    title: str,
    *,
    about: Sequence[str],
    facts: Mapping[str, str],
    panels: Sequence[Panel],
    tables: Sequence[Table],
    live: LivePart | None = None,
) -> str:
    """The whole document. All texts are escaped here, except those of `live`.

    `about` is shown once, at the top; it includes the notes of all tables. The terms explain the tables.
    """
    live = live or LivePart("", "", "")
    said = "".join(f"<p>{escape(line)}</p>" for line in about)
    terms = f'<section id="terms"><h2>Terms</h2><dl>{_pairs(TERMS)}</dl></section>' if tables else ""
    parts = [
        "<!doctype html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{live.policy}{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        '<link rel="icon" href="data:,">',
        f"<title>{escape(title)}</title>",
        f"<style>{page_file('/live/live.css').path.read_text()}</style>",
        "</head>",
        "<body>",
        f'<header><h1>{escape(title)}</h1><p id="state" role="status"></p></header>',
        "<main>",
        f'<section id="about">{said}<dl class="facts">{_pairs(facts)}</dl></section>',
        live.main,
        f'<div class="charts" id="pictures">{"".join(map(_panel, panels))}</div>',
        *(_table(table, f"table-{number}") for number, table in enumerate(tables, 1)),
        terms,
        "</main>",
        live.scripts,
        "</body>",
        "</html>",
        "",
    ]
    return "\n".join(parts)


def _pairs(texts: Mapping[str, str]) -> str:
    pairs = (f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in texts.items())
    return "".join(pairs)


def _panel(panel: Panel) -> str:
    picture = ""
    if panel.picture:
        kind = "png" if panel.picture.startswith(b"\x89PNG") else "svg+xml"
        data = base64.b64encode(panel.picture).decode()
        picture = f'<img src="data:image/{kind};base64,{data}" alt="{escape(panel.title)}">'
    caption = f"<figcaption>{escape(panel.caption)}</figcaption>"
    return f'<figure id="picture-{panel.name}"><h2>{escape(panel.title)}</h2>{picture}{caption}</figure>'


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


def live_part(source: Path, kind: str | None) -> LivePart:
    """The page of the tasks of this kind in a trace or in the folder of a run. It needs plotly."""
    script = "".join(map(_module, MODULES))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return LivePart(
        main=page_file("/live").path.read_text().partition("<main>")[2].partition("</main>")[0],
        scripts=_data("packed-plotly", _packed(charts_file().read_bytes()))
        + _data("packed-look", _fitting(recorded_look(source, kind)))
        + f'<script type="module">{script}</script>',
        policy=f"script-src 'sha256-{digest}' blob:; ",
    )


def _module(name: str) -> str:
    """A module without its imports and exports: in one file all have the same scope."""
    text = page_file(f"/live/{name}.js").path.read_text()
    return re.sub(r"^export |^import .*\n", "", text, flags=re.MULTILINE)


def _fitting(look: Look) -> str:
    """The look, packed; without its first tasks if they do not fit."""
    packed = _packed(as_json(look))
    while len(packed) > LOOK_MAX and look.tasks:
        out = len(look.tasks) - int(0.9 * len(look.tasks) * LOOK_MAX / len(packed))
        look = replace(look, tasks=look.tasks[out:], left_out=look.left_out + out)
        packed = _packed(as_json(look))
    return packed


def _packed(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, mtime=0)).decode()


def _data(name: str, packed: str) -> str:
    return f'<script type="text/plain" id="{name}">{packed}</script>\n'
