"""How sites, policies and predictors look in charts: the same everywhere, told apart in colour and in grey.

Drawing with them is the business of `charts`.
"""

from dataclasses import dataclass, replace
from typing import Any

from offboard.loadgen.table.replay import ORACLE, RECORDED
from offboard.robot_client import policies
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PAPER = "paper"  # the published rule

STYLE: dict[str, Any] = {  # of matplotlib
    "axes.axisbelow": True,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.labelcolor": "#222222",
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same layout everywhere
    "font.size": 9,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "lines.dash_capstyle": "butt",
    "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "offboard",  # the same ids every time
    "text.parse_math": False,
    "xtick.color": "#555555",
    "xtick.labelcolor": "#222222",
    "ytick.color": "#555555",
    "ytick.labelcolor": "#222222",
}


@dataclass(frozen=True, slots=True)
class Look:
    """A colour, dashes and a marker, as matplotlib takes them."""

    colour: str
    line: Any = "-"
    marker: str = ""


# Told apart by colour-blind readers, at 3:1 or more against white; in grey the dashes and markers tell.
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
PRINTED = Look("#666666", "--", "D")  # the paper's own figures
NEUTRAL = Look("#444444", "-", "s")  # the key of what is drawn in several colours

_MARKERS = "sovPXD<>^"  # of predictors


def policy_look(name: str) -> Look:
    """The same look for the same policy in every report."""
    if name in LOOKS:
        return LOOKS[name]
    further = [other for other in policies.names() if other not in LOOKS]
    return FURTHER_LOOKS[further.index(name) % len(FURTHER_LOOKS)]


def predictor_look(look: Look, at: int, count: int) -> Look:
    """Of the `at`th of `count` predictors: a marker of its own, and a tint; the first has the full colour."""
    white = 0.55 * at / max(1, count - 1)
    parts = (int(look.colour[start : start + 2], 16) for start in (1, 3, 5))
    tint = "".join(f"{round((1 - white) * part + white * 255):02x}" for part in parts)
    return replace(look, colour=f"#{tint}", line="-", marker=_MARKERS[at % len(_MARKERS)])
