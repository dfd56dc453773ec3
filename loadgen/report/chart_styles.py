"""The look of sites, policies and predictors in charts, which can be told apart in colour and in grey.

Drawing is left to `charts.py`.
"""

import zlib
from dataclasses import dataclass, replace
from typing import Any

from offboard.loadgen import rivals
from offboard.loadgen.replay.replay import ORACLE, RECORDED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PAPER = "paper"  # the published rule

STYLE: dict[str, Any] = {  # settings of matplotlib
    "axes.axisbelow": True,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.labelcolor": "#222222",
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.sans-serif": ["DejaVu Sans"],  # is part of matplotlib, so the layout is the same everywhere
    "font.size": 9,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "lines.dash_capstyle": "butt",
    "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "offboard",  # the same ids in every report
    "text.parse_math": False,
    "xtick.color": "#555555",
    "xtick.labelcolor": "#222222",
    "ytick.color": "#555555",
    "ytick.labelcolor": "#222222",
}


@dataclass(frozen=True, slots=True)
class Look:
    """A colour, a line style and a marker, in the notation of matplotlib."""

    colour: str
    line: Any = "-"
    marker: str = ""


# Colour-blind readers can tell the colours apart, and they have a contrast of at least 3:1 to white.
# In grey, dashes and markers make the difference.
LOOKS = {
    ONBOARD: Look("#d55e00", "--", "^"),
    CLOUD: Look("#004488", "-.", "o"),
    PAPER: Look("#009e73", "-", "s"),
    ORACLE: Look("#222222", ":"),
    RECORDED: Look("#aa4499", (0, (6, 1, 1, 1, 1, 1))),
}
FURTHER_LOOKS = (
    Look("#3a86c8", (0, (8, 2))),
    Look("#7a7a1f", (0, (3, 1))),
    Look("#882255", (0, (5, 1, 1, 1))),
    Look("#2a8f80", (0, (2, 1))),
    Look("#a06a00", (0, (8, 1, 2, 1))),
    Look("#6650a4", (0, (4, 1, 2, 1))),
)
PRINTED = Look("#666666", "--", "D")  # the figures in the paper
NEUTRAL = Look("#444444", "-", "s")  # in the legend, for series that are drawn in several colours

_MARKERS = "sovPXD<>^"  # for predictors


def policy_look(name: str) -> Look:
    """The look of a policy, which is the same in every report."""
    if name in LOOKS:
        return LOOKS[name]
    further = [other for other in rivals.RULES if other not in LOOKS]
    number = further.index(name) if name in further else zlib.crc32(name.encode())
    return FURTHER_LOOKS[number % len(FURTHER_LOOKS)]


def predictor_look(look: Look, at: int, count: int) -> Look:
    """The look of predictor `at` of `count`: a marker and a tint; the first one has the full colour."""
    white = 0.55 * at / max(1, count - 1)
    parts = (int(look.colour[start : start + 2], 16) for start in (1, 3, 5))
    tint = "".join(f"{round((1 - white) * part + white * 255):02x}" for part in parts)
    return replace(look, colour=f"#{tint}", line="-", marker=_MARKERS[at % len(_MARKERS)])
