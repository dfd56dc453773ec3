"""The look of sites, predictors and runs in the charts of matplotlib: they differ in colour and in grey.

The colours are those of the page `/live`. Drawing is left to `charts.py`.
"""

from dataclasses import dataclass, replace
from typing import Any

from offboard.common.live.live_files import colours
from offboard.loadgen.replay.replay import ORACLE
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PAPER = "paper"  # the published rule
COLOURS = colours()

STYLE: dict[str, Any] = {  # settings of matplotlib
    "axes.axisbelow": True,
    "axes.edgecolor": COLOURS["faint"],
    "axes.grid": True,
    "axes.labelcolor": COLOURS["text"],
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.sans-serif": ["DejaVu Sans"],  # is part of matplotlib, so the layout is the same everywhere
    "font.size": 9,
    "grid.color": COLOURS["grid"],
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "lines.dash_capstyle": "butt",
    "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "offboard",  # the same ids in every report
    "text.parse_math": False,
    "xtick.color": COLOURS["faint"],
    "xtick.labelcolor": COLOURS["text"],
    "ytick.color": COLOURS["faint"],
    "ytick.labelcolor": COLOURS["text"],
}


@dataclass(frozen=True, slots=True)
class Look:
    """A colour, a line style and a marker, in the notation of matplotlib."""

    colour: str
    line: Any = "-"
    marker: str = ""


# In grey, dashes and markers make the difference.
LOOKS = {
    ONBOARD: Look(COLOURS["site-0"], "--", "^"),
    CLOUD: Look(COLOURS["site-1"], "-.", "o"),
    PAPER: Look(COLOURS["site-2"], "-", "s"),
    ORACLE: Look(COLOURS["text"], ":"),
}
RUN_LOOKS = (
    Look(COLOURS["site-0"], (0, (8, 2))),
    Look(COLOURS["site-1"], (0, (3, 1))),
    Look(COLOURS["site-2"], (0, (5, 1, 1, 1))),
    Look(COLOURS["site-3"], (0, (2, 1))),
    Look(COLOURS["text"], (0, (8, 1, 2, 1))),
    Look(COLOURS["faint"], (0, (4, 1, 2, 1))),
)
PRINTED = Look(COLOURS["faint"], "--", "D")  # the figures in the paper
NEUTRAL = Look(COLOURS["text"], "-", "s")  # in the legend, for series that are drawn in several colours

_MARKERS = "sovPXD<>^"  # for predictors


def predictor_look(look: Look, at: int, count: int) -> Look:
    """The look of predictor `at` of `count`: a marker and a tint; the first one has the full colour."""
    white = 0.55 * at / max(1, count - 1)
    parts = (int(look.colour[start : start + 2], 16) for start in (1, 3, 5))
    tint = "".join(f"{round((1 - white) * part + white * 255):02x}" for part in parts)
    return replace(look, colour=f"#{tint}", line="-", marker=_MARKERS[at % len(_MARKERS)])
