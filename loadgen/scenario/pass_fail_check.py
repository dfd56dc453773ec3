"""The pass/fail checks of a scenario: each compares one figure of the outcome with a limit.

How a figure is computed is in `outcome_figures`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from offboard.common.config import check, from_table, setting
from offboard.common.errors import ConfigError, DataError
from offboard.common.toml_file import line_of, unknown
from offboard.common.wording import rounded
from offboard.loadgen.scenario.event_timeline import list_of_tables
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES, SHARE, site_percent

CHECKS_MAX = 100
DIGITS = 4  # of a figure in a verdict


@dataclass(frozen=True)
class Check:
    """`[[check]]`: an upper or a lower limit for one figure.

    `fails_with` names a policy or a broken part. `make chaos` plays the scenario with it and expects the
    check to fail.
    """

    figure: str = setting("", "name of the figure")
    site: str = setting("", "the site whose share counts, for cloud_percent; else that of all servers")
    at_most: float | None = setting(None, "largest allowed value")
    at_least: float | None = setting(None, "smallest allowed value")
    from_task: int = setting(0, "first task that counts", minimum=0)
    to_task: int | None = setting(None, "first task that no longer counts", minimum=1)
    fails_with: str = setting("", "policy or broken part that makes this check fail")
    note: str = setting("", "explanation, printed when the check fails")

    def __post_init__(self) -> None:
        check(self)
        if self.figure not in FIGURES:
            raise ConfigError(f"figure: {unknown('figure', self.figure, tuple(FIGURES))}")
        if self.site and self.figure != SHARE:
            raise ConfigError(f"site: {self.site!r} is only for the figure {SHARE}")
        if (self.at_most is None) == (self.at_least is None):
            raise ConfigError("figure: give either at_most or at_least")
        if self.to_task is not None and self.to_task <= self.from_task:
            raise ConfigError(f"to_task: {self.to_task} is not above from_task {self.from_task}")

    def __str__(self) -> str:
        which, limit = ("at most", self.at_most) if self.at_most is not None else ("at least", self.at_least)
        of, unit = f" of {self.site}" if self.site else "", FIGURES[self.figure].unit
        return f"{self.figure}{of} {which} {limit:g}{f' {unit}' if unit else ''}{self._span()}"

    def _span(self) -> str:
        if self.to_task is not None:
            return f", tasks {self.from_task} to {self.to_task - 1}"
        return f", from task {self.from_task} on" if self.from_task else ""

    def judge(self, run: Outcome) -> "Verdict":
        run = run.between(self.from_task, self.to_task)
        value = site_percent(run, self.site) if self.site else FIGURES[self.figure].compute(run)
        if value is None:
            return Verdict(self, None, holds=False)
        holds = value <= self.at_most if self.at_most is not None else value >= (self.at_least or 0.0)
        return Verdict(self, value, holds)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of a check; `value` is None if the figure is undefined for the tasks that count."""

    check: Check
    value: float | None
    holds: bool

    def __str__(self) -> str:
        if self.value is None:
            return f"FAILS  {self.check}: undefined for these tasks"
        if self.holds:
            return f"holds  {self.check}: {rounded(self.value, DIGITS)}"
        limit = self.check.at_most if self.check.at_most is not None else self.check.at_least
        assert limit is not None
        side = "above" if self.value > limit else "below"
        note = f" ({self.check.note})" if self.check.note else ""
        value, away = rounded(self.value, DIGITS), rounded(abs(self.value - limit), DIGITS)
        return f"FAILS  {self.check}: {value}, {away} {side} the limit{note}"

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self.check), "value": self.value, "holds": self.holds}


def parse_checks(
    table: Mapping[str, Any], path: Path, *, tasks: int, known: Mapping[str, bool], sites: Sequence[str]
) -> tuple[Check, ...]:
    """The checks in a scenario file; DataError names file and line.

    `tasks` and `known` describe the workload, `sites` are those of the scenario. A check that no run of it
    can compute is an error too.
    """
    lines = path.read_text().splitlines()
    checks = []
    for number, one in enumerate(list_of_tables(table, "check", path, most=CHECKS_MAX), 1):
        place = f"{path}:{line_of(lines, 'check', number, 'figure')}"
        for key in one:
            if key not in Check.__dataclass_fields__:
                line = line_of(lines, "check", number, key)
                raise DataError(f"{path}:{line}: {unknown('key', key, tuple(Check.__dataclass_fields__))}")
        try:
            checks.append(from_table(Check, one, path, f"check {number}"))
            check_computable(checks[-1], tasks=tasks, known=known)
            if checks[-1].site not in ("", *sites):
                raise ConfigError(f"site: {checks[-1].site!r} is not one of {', '.join(sites)}")
        except DataError as error:
            raise DataError(f"{place}: {str(error).removeprefix(f'{path}: ')}") from None
        except ConfigError as error:
            raise DataError(f"{place}: {error}") from None
    return tuple(checks)


def check_computable(one: Check, *, tasks: int, known: Mapping[str, bool]) -> None:
    """ConfigError if a run with this many tasks can never compute the check.

    `known` says which optional settings of the workload are present.
    """
    needs = FIGURES[one.figure].needs
    if needs is not None and not known[needs]:
        raise ConfigError(f"check {one}: cannot be computed without workload.{needs}")
    if max(one.from_task, (one.to_task or 1) - 1) >= tasks:
        last = one.to_task if one.to_task is not None and one.to_task > tasks else one.from_task
        raise ConfigError(
            f"check {one}: cannot be computed, task {last} is not among the {tasks} of the workload"
        )
