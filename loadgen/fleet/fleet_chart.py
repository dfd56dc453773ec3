"""The chart of `loadgen fleet`: times, regret and the shares of the servers against the number of robots."""

from collections.abc import Sequence

from offboard.loadgen.fleet.fleet_figures import FleetLine
from offboard.loadgen.replay.replay import ORACLE
from offboard.loadgen.report.chart_parts import Drawing, Figure, key, legend, logarithmic, render
from offboard.loadgen.report.chart_styles import LOOKS, RUN_LOOKS
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PANEL_IN = 1.9


def draw(lines: Sequence[FleetLine]) -> Drawing:
    """Three panels, one below the other."""
    return render(lambda figure: _paint(figure, sorted(lines, key=lambda line: line.robots)))


def _paint(figure: Figure, lines: Sequence[FleetLine]) -> None:
    times, regret, shares = figure.subplots(3, sharex=True)
    robots = [line.robots for line in lines]
    mean, p99, most, least = LOOKS[CLOUD], LOOKS[ONBOARD], RUN_LOOKS[2], RUN_LOOKS[3]
    for axes, look, values, gid in (
        (times, mean, [line.mean_ms for line in lines], "mean"),
        (times, p99, [line.p99_ms for line in lines], "p99"),
        (regret, LOOKS[ORACLE], [line.regret_ms for line in lines], "regret"),
        (shares, most, [line.busiest for line in lines], "busiest"),
        (shares, least, [line.idlest for line in lines], "idlest"),
    ):
        axes.plot(robots, values, color=look.colour, linestyle=look.line, marker="o", gid=gid)
    for axes in (times, regret, shares):  # only now: the upper end must be above all lines
        axes.set_ylim(bottom=0)
    times.set_ylabel("time (ms)")
    regret.set_ylabel("regret (ms)")
    shares.set(xlabel="robots", ylabel="server / mean")
    if robots[-1] > robots[0]:
        logarithmic(shares.set_xscale, shares.xaxis, robots[0], robots[-1])
    figure.align_ylabels()
    keys = [key(mean, "mean"), key(p99, "P99"), key(most, "busiest server"), key(least, "idlest server")]
    legend(figure, keys, columns=4)
    figure.set_figheight(3 * PANEL_IN)
