"""The parts that several charts share: points, legend, scales, and the drawing of a figure to files.

This is the only file that imports matplotlib.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.report.chart_styles import LOOKS, STYLE, Look
from offboard.loadgen.table.measured_rows import Column

try:
    import matplotlib.style
    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis as Axis
    from matplotlib.colors import to_rgba as to_rgba
    from matplotlib.figure import Figure as Figure
    from matplotlib.lines import Line2D as Line2D
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
    from matplotlib.ticker import PercentFormatter as PercentFormatter
except ImportError as error:
    raise MissingExtra("loadgen report", "report") from error

WIDTH_IN, HEIGHT_IN = 4.8, 3.5  # narrow, so that the letters stay legible on the screen of a phone
PNG_DPI = 300
FAR = 10  # the scale of times is logarithmic if the longest time is over FAR times the median
LEGEND_LINE_IN = 0.2
LABELS_TO = 100  # a logarithmic scale labels 2 and 5 too, if its greatest value is up to 100 times its least


@dataclass(frozen=True, slots=True)
class Drawing:
    """One chart as two files."""

    svg: bytes
    png: bytes


def render(paint: Callable[[Figure], None]) -> Drawing:
    """Let `paint` fill a figure, and return its files. Matplotlib settings of the user are ignored."""
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        paint(figure)
        svg, png = io.BytesIO(), io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})  # the same bytes on each day
        figure.savefig(png, format="png", dpi=PNG_DPI)
        return Drawing(svg.getvalue(), png.getvalue())


def points(axes: Axes, x: Any, seconds: Column, site: str, *, gid: str, opacity: float) -> None:
    """Draw one point for each task, in the look of its site."""
    axes.plot(
        x,
        seconds,
        linestyle="",
        marker=LOOKS[site].marker,
        markersize=3.6,
        markerfacecolor=to_rgba(LOOKS[site].colour, opacity),
        markeredgecolor="none",
        gid=gid,
    )


def scale_times(set_scale: Callable[[str], None], axis: Axis, seconds: Column) -> None:
    """Make the scale logarithmic if a few times are so long that the others would lie on the axis."""
    low, high = float(seconds.min()), float(seconds.max())
    if low > 0 and high > FAR * float(np.median(seconds)):
        logarithmic(set_scale, axis, low, high)


def logarithmic(set_scale: Callable[[str], None], axis: Axis, low: float, high: float) -> None:
    """Make the scale of an axis logarithmic, with plain numbers as labels."""
    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high <= LABELS_TO * low else (1,)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def key(look: Look, label: str, *, hollow: bool = False) -> Line2D:
    face = "white" if hollow else look.colour
    return Line2D(
        [], [], color=look.colour, linestyle=look.line, marker=look.marker, markerfacecolor=face, label=label
    )


def legend(figure: Figure, keys: Sequence[Line2D], columns: int) -> None:
    """Put the legend above the chart, and make the figure higher for it."""
    figure.legend(handles=keys, loc="outside upper left", ncols=columns)
    figure.set_figheight(HEIGHT_IN + LEGEND_LINE_IN * max(0, ceil(len(keys) / columns) - 2))
