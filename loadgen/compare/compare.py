"""`loadgen compare`: the same seeded scenario once per policy, in turn, and how they did with intervals.

The runs of one seed follow each other, and each policy comes first equally often: whatever else the machine
does meets all of them alike. `--simulate` starts nothing, and gives a table over all scenarios first.
"""

import itertools
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen.compare.machine_speed import at_one_speed, speed_slope
from offboard.loadgen.compare.resume import PLAYS_MAX, play_once
from offboard.loadgen.play.play import TESTBEDS
from offboard.loadgen.play.stolen_time import NOTED_PERCENT
from offboard.loadgen.scenario.interval_coverage import interval_columns, interval_figures
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.recovery import median_recovery
from offboard.loadgen.scenario.scenario import Scenario, find_scenario, read_scenario
from offboard.loadgen.table.bootstrap import BOUNDS, Blocks, Picks, percentiles
from offboard.loadgen.table.render import FORMATS, Heading, Table, render
from offboard.loadgen.table.rows import Column
from offboard.loadgen.table.score import quantile
from offboard.robot_client import policies, predictors
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

SEEDS_MAX = 1000
JOBS_MAX = 256
SIMULATION = "simulation"


@dataclass(frozen=True)
class CompareConfig:
    """What is compared, and where it is played."""

    policies: tuple[str, ...] = setting(
        ("paper", policies.DEFAULT, ONBOARD, CLOUD),
        f"policies to play: {policies.HELP}; @PREDICTOR behind one: not by its own",
        metavar="NAME,NAME,..",
    )
    seeds: int = setting(
        3, "runs of each policy, with the scenario's seed and those after it", minimum=1, maximum=SEEDS_MAX
    )
    testbed: str = setting("local", "where it is played: processes, or containers", choices=tuple(TESTBEDS))
    out: Path = setting(
        Path("out/compare"),
        "folder for the runs: SCENARIO/SEED-POLICY; those of the same software and settings that came to"
        " their end there are not played again",
        metavar="DIR",
    )
    tasks: int | None = setting(None, "instead of the scenario's own", minimum=1)
    reference: int | None = setting(
        None,
        "instead of the scenario's own: every K-th task again on each site alone; 0: none, which is quicker",
        minimum=0,
    )
    from_task: int = setting(0, "only tasks from this one on, such as those after warm-up", minimum=0)
    format: str = setting("md", "output format", choices=FORMATS)
    stolen_max: float | None = setting(
        None,
        f"a run of whose CPU time the host took more than so many percent is played again, {PLAYS_MAX} times"
        " at most; without, the table says how much it was",
        minimum=0,
        maximum=100,
        metavar="PERCENT",
    )
    simulate: bool = setting(False, "play in simulation: virtual time, modelled sites, nothing is started")
    jobs: int | None = setting(
        None, "with --simulate: so many processes; without, one a CPU", minimum=1, maximum=JOBS_MAX
    )

    def __post_init__(self) -> None:
        check(self)
        for policy in self.policies:
            split_strategy(policy)
        if len(set(self.policies)) < len(self.policies):
            raise ConfigError(f"--policies: {','.join(self.policies)}: one is named twice")
        if self.jobs is not None and not self.simulate:
            raise ConfigError(f"--jobs: {self.jobs} needs --simulate: real runs follow each other")
        if self.simulate and self.testbed != "local":
            raise ConfigError(f"--testbed: {self.testbed} is not allowed beside --simulate")
        if self.simulate and self.stolen_max is not None:
            raise ConfigError(f"--stolen-max: {self.stolen_max:g} is not allowed beside --simulate")

    @property
    def where(self) -> str:
        """What the runs are on."""
        return SIMULATION if self.simulate else self.testbed


@dataclass(frozen=True, slots=True)
class Line:
    """How one policy did with the tasks of all its runs; None: undefined.

    `over_first` is its mean time over that of the first policy, on the same tasks; `server_over_first` is
    what the server itself took over what it took for the first, where both sent a task there, and
    `at_one_speed` the first ratio with that taken out. `recovery` counts tasks after an outage.
    `coverage_percent` and the widths are of the predictions' intervals: over the predicted time, and over the
    constant width that holds as many. `time_over_oracle` and `regret_ms` are of the `referenced` tasks, which
    each site ran alone too.
    """

    policy: str
    bound: str = ""
    tasks: int = 0
    lost: int | None = None
    mean_ms: float | None = None
    over_first: float | None = None
    at_one_speed: float | None = None
    server_over_first: float | None = None
    p95_ms: float | None = None
    p99_ms: float | None = None
    late_percent: float | None = None
    cloud_percent: float | None = None
    twice_percent: float | None = None
    recovery: float | None = None
    coverage_percent: float | None = None
    relative_width: float | None = None
    width_over_constant: float | None = None
    referenced: int = 0
    time_over_oracle: float | None = None
    regret_ms: float | None = None
    note: str = ""


HEADINGS: dict[str, Heading] = {
    "policy": Heading("policy", "policy", None),
    "bound": Heading("bound", "bound", None),
    "tasks": Heading("tasks", "tasks", 0),
    "lost": Heading("lost", "lost", 0),
    "mean_ms": Heading("mean ms", "mean", 1),
    "over_first": Heading("/ first", "/ first", 3),
    "at_one_speed": Heading("at one speed", "at one speed", 3),
    "server_over_first": Heading("server / first", "server / first", 3),
    "p95_ms": Heading("P95 ms", "P95", 1),
    "p99_ms": Heading("P99 ms", "P99", 1),
    "late_percent": Heading("late %", r"late \%", 2),
    "cloud_percent": Heading("cloud %", r"cloud \%", 1),
    "twice_percent": Heading("twice %", r"twice \%", 1),
    "recovery": Heading("recovery", "recovery", 1),
    "coverage_percent": Heading("coverage %", r"coverage \%", 1),
    "relative_width": Heading("width", "width", 2),
    "width_over_constant": Heading("/ constant", "/ constant", 2),
    "referenced": Heading("referenced", "referenced", 0),
    "time_over_oracle": Heading("time/oracle", "time/oracle", 3),
    "regret_ms": Heading("regret ms", "regret", 1),
}


def run_compare(names: Sequence[str], config: CompareConfig) -> int:
    """Play all, then print a table a scenario to stdout; how far it is goes to stderr."""
    scenarios = [
        read_scenario(find_scenario(name)).changed(tasks=config.tasks, reference=config.reference)
        for name in names
    ]
    for scenario in scenarios:
        if config.from_task >= scenario.workload.tasks:
            wrong = f"--from-task: {config.from_task} is not among the {scenario.workload.tasks} tasks"
            raise ConfigError(f"{wrong} of {scenario.name}")
    if config.simulate:
        from offboard.loadgen.compare.simulated_tables import simulated

        sys.stdout.write(simulated(scenarios, config))
    else:
        sys.stdout.write(render([compare(scenario, config) for scenario in scenarios], config.format))
    return 0


def compare(scenario: Scenario, config: CompareConfig) -> Table:
    """Play the scenario once for each seed and policy, and sum up."""
    runs: dict[str, list[Outcome]] = {policy: [] for policy in config.policies}
    stolen: dict[str, float] = {}
    for n in range(config.seeds):
        seed = scenario.seed + n
        for policy in turned(config.policies, n):
            out = config.out / scenario.name / f"{seed}-{policy}"
            print(f"{scenario.name}, seed {seed}, policy {policy}", file=sys.stderr, flush=True)
            chosen, predictor = split_strategy(policy)
            changed = scenario.changed(seed=seed, policy=chosen, predictor=predictor)
            played = play_once(changed, out, config.testbed, config.stolen_max)
            runs[policy].append(played.outcome.of(scenario.compared()).between(config.from_task))
            if played.stolen_percent is not None:
                stolen[out.name] = played.stolen_percent
    return replace(table(scenario, config, runs), notes=_host_notes(stolen))


def _host_notes(stolen: Mapping[str, float]) -> tuple[str, ...]:
    """What the host took of the runs, percent by name, where that is too much to tell policies apart."""
    worst = max(stolen, key=stolen.__getitem__, default=None)
    if worst is None or stolen[worst] < NOTED_PERCENT:
        return ()
    return (
        f"The host of this machine took {median(stolen.values()):.0f} % of the CPU time that the median run"
        f" asked for, {stolen[worst]:.0f} % of {worst}: such times tell of the host too (--stolen-max).",
    )


def split_strategy(name: str) -> tuple[str, str | None]:
    """Policy and predictor of POLICY or POLICY@PREDICTOR."""
    policy, at, predictor = name.partition("@")
    policies.check_name(policy, "--policies")
    if at:
        predictors.check_name(predictor, "--policies")
    return policy, predictor if at else None


def turned(names: Sequence[str], turn: int) -> Sequence[str]:
    """The same, another one first every turn."""
    start = turn % len(names)
    return [*names[start:], *names[:start]]


def table(
    scenario: Scenario,
    config: CompareConfig,
    runs: Mapping[str, Sequence[Outcome]],
    each: Callable[..., Iterable[list[Line]]] = map,
) -> Table:
    """A line for each policy, and its 95 % interval below it; `each` maps, perhaps with several processes."""
    names, first = config.policies, runs[config.policies[0]]
    found = each(_lines, names, [runs[name] for name in names], [first for _ in names])
    lines = list(itertools.chain.from_iterable(found))
    span = f" from task {config.from_task} on" if config.from_task else ""
    place = f"in {SIMULATION}" if config.simulate else f"on the {config.testbed} testbed"
    caption = (
        f"Scenario {scenario.name} {place}: {config.seeds} runs of each policy"
        f" with seeds {scenario.seed} to {scenario.seed + config.seeds - 1},"
        f" {scenario.workload.tasks} tasks a robot{span};"
        " bounds are 95 % intervals over blocks of neighbouring tasks."
    )
    about = {"scenario": scenario.name, "testbed": config.where, "seeds": config.seeds}
    return Table(caption=caption, about=about, headings=HEADINGS, lines=lines)


def _lines(policy: str, runs: Sequence[Outcome], first: Sequence[Outcome]) -> list[Line]:
    asked = sum(sum(run.asked.values()) for run in runs)
    columns, referenced = _columns(runs, first), _referenced(runs)
    count = len(columns["response_s"])
    lost = asked - count
    counts: dict[str, Any] = {"tasks": count, "referenced": len(referenced["sent_s"])}
    if not count:
        return [Line(policy, lost=lost, **counts)]
    one = np.arange(count)[None]
    measured: dict[str, Any] = _task_figures(columns, one)
    own = np.arange(counts["referenced"])[None]
    measured |= _reference_figures(referenced, own) if counts["referenced"] else {}
    resampled = Blocks(count).resampled(lambda picks: _task_figures(columns, picks))
    if resampled:
        slope = speed_slope(resampled)
        for figures in (measured, resampled):
            figures["at_one_speed"] = at_one_speed(figures, slope)
    bounds = percentiles(resampled)
    if counts["referenced"]:
        more = Blocks(counts["referenced"]).intervals(lambda picks: _reference_figures(referenced, picks))
        bounds = tuple({**bound, **other} for bound, other in zip(bounds, more, strict=True))
    measured = counts | {name: _plain(value[0]) for name, value in measured.items()}
    measured["recovery"], note = median_recovery(runs)
    ends = [Line(policy, name, **counts, **bound) for name, bound in zip(BOUNDS, bounds, strict=True)]
    return [Line(policy, lost=lost, note=note, **measured), *ends]


def _columns(runs: Sequence[Outcome], first: Sequence[Outcome]) -> dict[str, Column]:
    """One value a task; NaN where it has none."""
    tasks: list[Answered] = []
    firsts: list[Answered | None] = []
    late: list[float] = []
    for run, other in zip(runs, first, strict=True):
        theirs = {(one.robot, one.i): one for one in other.answered}
        mine = sorted(run.answered, key=lambda one: (one.robot, one.i))
        tasks += mine
        firsts += [theirs.get((one.robot, one.i)) for one in mine]
        late += [np.nan if run.deadline_s is None else one.response_s > run.deadline_s for one in mine]
    return {
        "response_s": np.array([one.response_s for one in tasks]),
        "first_s": np.array([np.nan if one is None else one.response_s for one in firsts]),
        "server_s": np.array([one.server_s for one in tasks], dtype=float),
        "first_server_s": np.array([None if one is None else one.server_s for one in firsts], dtype=float),
        "late": np.array(late, dtype=float),
        "cloud": np.array([np.nan if one.both or not one.chosen else one.chosen == CLOUD for one in tasks]),
        "twice": np.array([len(one.sites) > 1 for one in tasks], dtype=float),
        **interval_columns([one.intervals for one in tasks]),
    }


def _referenced(runs: Sequence[Outcome]) -> dict[str, Column]:
    references = [one for run in runs for one in run.references]
    return {
        "sent_s": np.array([one.sent_s for one in references]),
        "oracle_s": np.array([one.oracle_s for one in references]),
    }


def _task_figures(columns: Mapping[str, Column], picks: Picks) -> dict[str, Column]:
    """Figures of each resample (a row of `picks`)."""
    response, first = columns["response_s"][picks], columns["first_s"][picks]
    server, first_server = columns["server_s"][picks], columns["first_server_s"][picks]
    return {
        "mean_ms": 1e3 * response.mean(axis=-1),
        "over_first": _ratio(response, first),
        "server_over_first": _ratio(server, first_server),
        "p95_ms": 1e3 * quantile(response, 95),
        "p99_ms": 1e3 * quantile(response, 99),
        "late_percent": 100 * _mean(columns["late"][picks]),
        "cloud_percent": 100 * _mean(columns["cloud"][picks]),
        "twice_percent": 100 * _mean(columns["twice"][picks]),
        **interval_figures(columns, picks),
    }


def _reference_figures(columns: Mapping[str, Column], picks: Picks) -> dict[str, Column]:
    sent, oracle = columns["sent_s"][picks], columns["oracle_s"][picks]
    return {
        "time_over_oracle": _ratio(sent, oracle),
        "regret_ms": 1e3 * (sent - oracle).mean(axis=-1),
    }


def _mean(values: Column) -> Column:
    """Over what is there; NaN where nothing is."""
    there = ~np.isnan(values)
    total, count = np.where(there, values, 0.0).sum(axis=-1), there.sum(axis=-1)
    mean: Column = np.divide(total, count, where=count > 0, out=np.full(len(values), np.nan))
    return mean


def _ratio(over: Column, under: Column) -> Column:
    """Of the sums over what both have; NaN where there is nothing."""
    both = ~(np.isnan(over) | np.isnan(under))
    upper, lower = np.where(both, over, 0.0).sum(axis=-1), np.where(both, under, 0.0).sum(axis=-1)
    ratio: Column = np.divide(upper, lower, where=lower > 0, out=np.full(len(over), np.nan))
    return ratio


def _plain(value: Any) -> float | None:
    return None if np.isnan(value) else float(value)
