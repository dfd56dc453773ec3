"""The steps of `make figures`: what is measured by which commands, as docs/figures/steps.toml says.

`measured` keeps their results, `page` shows them.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError, OffloadError
from offboard.common.toml_file import read_toml, unknown
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped
from offboard.loadgen.simulation.simulated_testbed import check_simulated

ROOT = Path(__file__).parents[2]
FOLDER = Path("docs/figures")
STEPS = FOLDER / "steps.toml"
PART = "{part}"  # in a command: the name of the part
OUT = "{out}"  # in a command: the folder that belongs to the step or part
WORK = Path("out/figures/work")
SCENARIOS = (Path("loadgen/scenarios"), Path("loadgen/links"))
DATASETS = ("paper", "congested", "apriltags", "drive", "drive-busy")  # in the order of their page
SOAK = "soak"  # half an hour: `make chaos` plays it


@dataclass(frozen=True, eq=False)
class Step:
    """One part of a page of figures, and what measures it.

    - `run`: commands as a user types them; what they print is shown. {out} is a folder of their
      own, and holds only what the same commands have left there at the same commit
    - `parts`: the commands run once for each part, and each part is a file of its own
    - `merge`: heading of the column that holds the parts, if the page shows their tables as
      one; of the text, it then shows only the notes
    - `brackets`: ends of intervals are shown in brackets; `pivot`: the heading whose cells become the columns
      of the shown table, and the heading of the cells in it
    - `environment`, `ready`: where the commands are, and the files that make builds first
    - `reads`: files of measured rows, and `scenarios`: names or patterns of scenarios; a step is
      measured again if one of them changes
    - `copies`: pictures that go from the folder of the run to the docs
    - `plain`: the output is no Markdown; `first_table`: the page shows only the first table of it
    """

    section: str
    name: str
    title: str
    about: str
    run: tuple[str, ...]
    minutes: float
    parts: tuple[str, ...] = ()
    merge: str = ""
    brackets: bool = False
    pivot: tuple[str, ...] = ()
    environment: str = ".venv"
    ready: tuple[str, ...] = ()
    needs: str = ""
    reads: tuple[str, ...] = ()
    scenarios: tuple[str, ...] = ()
    copies: Mapping[str, str] = field(default_factory=dict)
    plain: bool = False
    first_table: bool = False

    def units(self) -> Iterator["Unit"]:
        for part in self.parts or ("",):
            yield Unit(self, part)


@dataclass(frozen=True)
class Unit:
    """A step, or one part of it: what is measured and kept as one file."""

    step: Step
    part: str = ""

    @property
    def name(self) -> str:
        return f"{self.step.name}/{self.part}" if self.part else self.step.name

    @property
    def file(self) -> Path:
        """Where its result is, from the root of the checkout."""
        return FOLDER / f"{self.name}.json"

    @property
    def work(self) -> Path:
        """The folder {out} of its commands, from the root of the checkout."""
        return WORK / self.name

    def commands(self) -> list[str]:
        return [self._named(command) for command in self.step.run]

    def copies(self) -> dict[Path, Path]:
        return {Path(self._named(a)): Path(self._named(b)) for a, b in self.step.copies.items()}

    def reads(self, root: Path) -> dict[str, dict[str, str]]:
        """The digest of each scenario and file of rows, and the commit at which the rows were measured."""
        found = {name: {"sha256": _digest(root / name)} for name in self._scenarios(root)}
        for name in map(self._named, self.step.reads):
            path = root / name
            if not path.is_file():
                raise OffloadError(f"{name} is missing: measure it first")
            about = path.with_suffix(".json")
            try:
                commit = json.loads(about.read_text()).get("commit")
            except (OSError, ValueError, AttributeError) as error:
                raise DataError(f"{about}: does not tell how {path.name} was measured: {error}") from None
            found[name] = {"sha256": _digest(path), "commit": str(commit or "unknown")}
        return found

    def _scenarios(self, root: Path) -> Iterator[str]:
        for pattern in map(self._named, self.step.scenarios):
            paths = sorted(path for folder in SCENARIOS for path in (root / folder).glob(f"{pattern}.toml"))
            if not paths:
                raise OffloadError(f"{STEPS}: {self.name}: there is no scenario {pattern}")
            yield from (path.relative_to(root).as_posix() for path in paths)

    def _named(self, text: str) -> str:
        return text.replace(PART, self.part).replace(OUT, str(self.work))


@dataclass(frozen=True)
class Section:
    """A page of figures: docs/figures/PAGE.md."""

    page: str
    title: str
    about: str
    steps: tuple[Step, ...]

    @property
    def path(self) -> Path:
        """Where it is, from the root of the checkout."""
        return FOLDER / f"{self.page}.md"


def read_sections(path: Path) -> list[Section]:
    """The steps in the order of the pages; DataError if the file is wrong."""
    try:
        tables = read_toml(path)["section"]
        sections = [
            Section(
                one["page"],
                one["title"],
                one.get("about", "").strip(),
                tuple(_step(one["title"], table) for table in one["step"]),
            )
            for one in tables
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: {error!r}") from None
    names = [step.name for section in sections for step in section.steps]
    if doubled := {name for name in names if names.count(name) > 1}:
        raise DataError(f"{path}: two steps are named {', '.join(sorted(doubled))}")
    pages = [section.page for section in sections]
    if doubled := {page for page in pages if pages.count(page) > 1}:
        raise DataError(f"{path}: two sections have the page {', '.join(sorted(doubled))}")
    return sections


def units_of(sections: Sequence[Section]) -> list[Unit]:
    return [unit for section in sections for step in section.steps for unit in step.units()]


def _step(section: str, table: Mapping[str, Any]) -> Step:
    known = tuple(one.name for one in fields(Step) if one.name != "section")
    for key in table:
        if key not in known:
            raise DataError(f"{STEPS}: {unknown('key', key, known)}")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    if isinstance(parts := values.get("parts"), str):
        if parts not in PARTS:
            raise DataError(f"{STEPS}: {unknown('parts', parts, tuple(PARTS))}")
        values["parts"] = PARTS[parts]()
    values["about"] = values["about"].strip()
    return Step(section=section, **values)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def checked_scenarios(*, applications: bool = False) -> tuple[str, ...]:
    """The shipped scenarios that have checks, without the soak: those of applications, or the others."""
    found = []
    for name in shipped():
        scenario = read_scenario(find_scenario(name))
        if scenario.checks and (scenario.workload.inputs is not None) == applications and name != SOAK:
            found.append(name)
    return tuple(found)


def simulated_scenarios() -> tuple[str, ...]:
    """Those of them that can be simulated."""
    found = []
    for name in checked_scenarios():
        try:
            check_simulated(read_scenario(find_scenario(name)))
        except OffloadError:
            continue
        found.append(name)
    return tuple(found)


# Lists that the file names by a word, so that a new scenario cannot be forgotten.
PARTS = {
    "checked scenarios": checked_scenarios,
    "checked applications": partial(checked_scenarios, applications=True),
    "simulated scenarios": simulated_scenarios,
    "datasets": lambda: DATASETS,
}
