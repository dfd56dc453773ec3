"""The figures of the docs: every page shows what the files of `make figures` hold, and no other figure."""

import json
import os
import platform
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.figures.__main__ import main
from benchmarks.figures.markdown_tables import joined, notes_of, tables_of
from benchmarks.figures.measured import OTHER_FILES, Measured, machine_of, measure, read_all, why_old
from benchmarks.figures.page import doubled_titles, filled, overview, pages, section_page
from benchmarks.figures.step import FOLDER, ROOT, STEPS, Section, Step, Unit, read_sections, units_of
from offboard.common.errors import DataError, OffloadError
from offboard.loadgen.__main__ import COMMANDS
from offboard.loadgen.scenario.scenario_file import find_scenario
from tests.loose_figures import ALLOWED, loose_figures
from tests.loose_figures import pages as pages_of_docs

SECTIONS = read_sections(ROOT / STEPS)
UNITS = units_of(SECTIONS)
FILES = read_all(UNITS)
SPEED = """\
## Speed

| case | ms |
| --- | ---: |
| calm | 1.25 |
| busy | 4.50 |

- calm: 1.25, at most 2: holds
"""
MEASURED = Measured(
    commit="abc1234",
    date="2026-11-26",
    machine={"cpu": "AMD EPYC", "cores": 2, "memory_gib": 8, "kernel": "Linux 6.1", "python": "3.11.7"},
    stolen_percent=0.5,
    commands=["python -m speed"],
    reads={},
    seconds=3.0,
    output=SPEED.strip().splitlines(),
)


def step(**changed: object) -> Step:
    about = {"section": "S", "name": "speed", "title": "Speed", "about": "How fast.", "minutes": 1}
    return Step(**({"run": ("python -m speed",)} | about | changed))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def checkout() -> None:
    """Skips where Python runs an installed offboard, as in the image: figures are measured of a checkout."""
    try:
        machine_of({**os.environ, "PATH": f"{Path(sys.prefix, 'bin')}:{os.environ['PATH']}"})
    except OffloadError as error:
        pytest.skip(str(error))


def test_every_page_shows_what_the_files_hold() -> None:
    """The pages of figures, and the blocks of all other pages, equal the files of the steps byte by byte."""
    wrong = [
        str(path)
        for path, text in pages(ROOT, SECTIONS, FILES).items()
        if (ROOT / path).read_text(encoding="utf-8") != text
    ]
    assert wrong == [], "run `make figures`, or `python -m benchmarks.figures --write`"


def test_the_results_page_stays_short() -> None:
    """It has the sections that decide, and at most 400 lines; every other page of figures is generated."""
    lines = (ROOT / "docs/results.md").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("## ")] == [
        *("## Does it pay?", "## Applications", "## Real links", "## A remote call", "## Scale"),
        "## The design",
    ]
    assert len(lines) <= 400
    there = {path.relative_to(ROOT) for path in (ROOT / FOLDER).glob("*.md")}
    assert there == {path for path in pages(ROOT, SECTIONS, FILES) if path.parent == FOLDER}


@pytest.mark.parametrize("page", pages_of_docs(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_figure_is_loose(page: Path) -> None:
    """Outside the blocks, each measured figure names its commit, or links to a page of figures."""
    name = page.relative_to(ROOT).as_posix()
    assert list(loose_figures(page.read_text(encoding="utf-8"), ALLOWED.get(name, ()))) == []


@pytest.mark.parametrize(
    "text",
    [
        "A decision took 35 us.",
        "It is 7 % faster than before, with an interval.",
        "A server runs 1.8 times as many tasks.",
        "The P99 was 90 ms instead of 520 ms.",
        "The time is 0.695 [0.626, 0.775] of that of the rule.",
        "| case | ms | P99 |\n| --- | --- | --- |\n| calm | 33.4 | 60.1 |",
    ],
)
def test_a_loose_figure_is_found(text: str) -> None:
    """A sentence and a table of figures are found, unless their commit or a page of figures is named."""
    assert list(loose_figures(f"# Page\n\n{text}\n")) == [text]
    assert list(loose_figures(f"# Page\n\n{text} At 141ddf2.\n")) == []
    assert list(loose_figures(f"# Page\n\n{text} See [results](results.md#speed).\n")) == []
    assert list(loose_figures(f"# Page\n\n{text} See [figures](figures/speed.md#speed).\n")) == []


@pytest.mark.parametrize(
    "text",
    [
        "The link has 30 ms of delay, and a task takes 48 ms there.",
        "| parameter | default |\n| --- | --- |\n| tolerance | 0.5 |",
        "A server is silent if a heartbeat has no answer after 0.25 s.",
        "```\ntook 35 us\n```",
        "<!-- figure: speed -->\n\nIt took 35 us.\n\n<!-- end -->",
    ],
)
def test_settings_and_blocks_are_no_loose_figures(text: str) -> None:
    """Settings, code and generated blocks are allowed."""
    assert list(loose_figures(f"# Page\n\n{text}\n")) == []


def test_the_files_are_those_of_steps() -> None:
    """No file is left of a step that is gone, so the page hides nothing."""
    known = {unit.file for unit in UNITS}
    assert {path.relative_to(ROOT) for path in (ROOT / FOLDER).rglob("*.json")} <= known
    assert doubled_titles(SECTIONS) == []


@pytest.mark.parametrize("unit", [next(step.units()) for one in SECTIONS for step in one.steps])
def test_the_commands_of_a_step_exist(unit: Unit) -> None:
    """Each command is a command of Offboard or a program of the checkout."""
    for command in unit.commands():
        words = shlex.split(command)
        words = words[words.index("python") :] if "python" in words else words
        if words[0] == "loadgen":
            assert words[1] in COMMANDS
        elif words[0] == "python":
            module = ROOT / words[2].replace(".", "/")
            assert module.with_suffix(".py").exists() or (module / "__main__.py").exists()
        else:
            assert (ROOT / words[0]).exists()


def test_the_page_says_what_is_of_another_commit_and_what_is_missing() -> None:
    """At its top it names the commit of most figures, the sections of others, and those not measured."""
    parts = step(name="parts", title="In parts", parts=("a", "b"))
    sections = [Section("speed", "S", "", (step(), parts, step(name="third", title="Third")))]
    files = {"speed": MEASURED, "parts/a": replace(MEASURED, commit="def5678", date="2026-11-20")}
    page = overview(sections, files)
    assert "**2 of 4 measurements are done**, and 1 of them are of commit abc1234 (2026-11-26)." in page
    assert "Of commit def5678:\n\n- [In parts](speed.md#in-parts) (a)\n" in page
    assert "Not measured yet:\n\n- [In parts](speed.md#in-parts) (b)\n- [Third](speed.md#third)\n" in page
    page = section_page(sections[0], files)
    assert "Commit abc1234, 2026-11-26; AMD EPYC, 2 cores, 8 GiB, Linux 6.1, Python 3.11.7." in page
    assert "## Third\n\nHow fast.\n\n```sh\npython -m speed\n```\n\nNot measured yet.\n" in page


def test_the_page_names_tables_of_other_rows_than_those_of_the_checkout() -> None:
    """If a dataset is measured again, its tables are not up to date until they are."""
    (unit,) = (one for one in UNITS if one.name == "table-two/paper")
    now = replace(MEASURED, reads=unit.reads(ROOT), commands=unit.commands())
    before = replace(now, reads={"loadgen/datasets/paper.csv": {"sha256": "0", "commit": "def5678"}})
    assert why_old(unit, now, "abc1234") == ""
    assert why_old(unit, before, "abc1234") == OTHER_FILES
    section = Section("speed", "S", "", (unit.step,))
    page = overview([section], {unit.name: before})
    assert "Of rows or scenarios that have changed since:\n\n- [Table II on our own datasets]" in page
    page = section_page(section, {unit.name: before})
    assert "rows of paper.csv of commit def5678" in page


def test_the_newest_commit_is_that_of_the_latest_second() -> None:
    """The page names it; a file without a time is of midnight, and one of other rows is not of the commit."""
    (table,) = (one for one in UNITS if one.name == "table-two/paper")
    parts = step(name="parts", title="In parts", parts=("a", "b"))
    files = {
        "parts/a": replace(MEASURED, commit="fff9999"),
        "parts/b": replace(MEASURED, commit="eee8888", date="2026-11-26T08:00:00Z"),
        "speed": replace(MEASURED, date="2026-11-26T09:00:00Z"),
        table.name: replace(MEASURED, reads={"rows.csv": {"sha256": "0", "commit": "def5678"}}),
    }
    page = overview(
        [Section("speed", "S", "", (parts, step(), replace(table.step, parts=("paper",))))], files
    )
    assert "**4 of 4 measurements are done**, and 1 of them are of commit abc1234 (2026-11-26)." in page


def test_a_block_holds_chosen_rows_and_columns() -> None:
    """It shows rows with the cells that it names, and the commit; an unknown column is an error."""
    text = "A\n\n<!-- figure: speed | case: busy | show: ms -->\nold\n<!-- end -->\nB\n"
    page, places = Path("docs/speed.md"), {"speed": FOLDER / "speed.md"}
    text = filled(text, page, {"speed": step()}, {"speed": MEASURED}, places)
    assert "\n| ms |\n| ---: |\n| 4.50 |\n\nCommit abc1234, 2026-11-26; " in text
    assert text.endswith("[All figures](figures/speed.md#speed).\n\n<!-- end -->\nB\n")
    assert filled(text, page, {"speed": step()}, {"speed": MEASURED}, places) == text
    assert "Not measured yet. [How" in filled(text, page, {"speed": step()}, {}, places)
    other = replace(MEASURED, output=["| a |", "| --- |"])
    with pytest.raises(DataError, match=r"docs/speed.md: .* there is no column 'case' in a"):
        filled(text, page, {"speed": step()}, {"speed": other}, places)
    with pytest.raises(DataError, match="there is no such step"):
        filled(text, page, {}, {}, {})


def test_a_block_holds_a_table_below_a_heading_or_those_of_all_parts() -> None:
    """The heading is one of the output; a column that is there twice cannot be chosen."""
    lines = ["## A", "| a | a |", "| --- | --- |", "| 1 | 2 |", "", "## B", "| b |", "| --- |", "| 3 |"]
    page, parts = Path("README.md"), step(parts=("x", "y"))
    files = {"speed": replace(MEASURED, output=lines)}
    files |= {"speed/x": MEASURED, "speed/y": replace(MEASURED, output=lines)}

    def shown(what: str, of: Step) -> str:
        return filled(f"<!-- figure: {what} -->\n<!-- end -->", page, {"speed": of}, files, places)

    places = {"speed": FOLDER / "speed.md"}
    assert "\n| b |\n| --- |\n| 3 |\n" in shown("speed | table: B", step())
    assert "\n| a | a |\n| --- | --- |\n| 1 | 2 |\n" in shown("speed", step())
    with pytest.raises(DataError, match="more than one column 'a'"):
        shown("speed | show: a", step())
    with pytest.raises(DataError, match="no heading 'C'"):
        shown("speed | table: C", step())
    with pytest.raises(DataError, match="tables have other columns"):
        shown("speed", parts)
    files["speed/y"] = MEASURED
    assert shown("speed", parts).count("| calm | 1.25 |") == 2


def test_tables_of_parts_become_one() -> None:
    """Parts become a column, ends of intervals brackets, and a column may be turned into columns."""
    lines = [
        *("| policy | bound | ms |", "| --- | --- | ---: |"),
        *("| a |  | 2 |", "| a | 2.5 % | 1 |", "| a | 97.5 % | 3 |", "| b |  | 5 |"),
        *("| b | 2.5 % | 5 |", "| b | 97.5 % | 6 |", "", "- one note"),
    ]
    table = joined("scenario", {"calm": lines, "busy": lines[:5]}).bracketed()
    assert table.headings == ("scenario", "policy", "ms")
    assert table.rows == (("calm", "a", "2 [1, 3]"), ("calm", "b", "5 [5, 6]"), ("busy", "a", "2 [1, 3]"))
    wide = table.pivoted("policy", "ms")
    assert wide.headings == ("scenario", "a", "b")
    assert wide.rows == (("calm", "2 [1, 3]", "5 [5, 6]"), ("busy", "2 [1, 3]", "–"))  # noqa: RUF001
    assert notes_of({"calm": lines, "busy": lines[:5]}) == ["- calm: one note"]
    assert len(tables_of(lines)) == 1


def test_bounds_belong_to_the_row_above_them() -> None:
    """A row may have none; two others than its own, or only one, are an error."""
    row, low, high, other = "| a |  | 2 |", "| a | 2.5 % | 1 |", "| a | 97.5 % | 3 |", "| b |  | 5 |"

    def bracketed(*rows: str) -> tuple[tuple[str, ...], ...]:
        (table,) = tables_of(["| policy | bound | ms |", "| --- | --- | ---: |", *rows])
        return table.bracketed().rows

    assert bracketed(other, row, low, high) == (("b", "5"), ("a", "2 [1, 3]"))
    for rows in ((row, low), (row, other, low, high), (low, high, row)):
        with pytest.raises(DataError, match="bounds"):
            bracketed(*rows)


@pytest.mark.parametrize("about", [None, "{", "[]"])
def test_rows_without_their_machine_are_one_line(tmp_path: Path, about: str | None) -> None:
    """A missing or broken JSON file next to rows is named, and their tables are not up to date."""
    (tmp_path / "rows.csv").write_text("1")
    if about is not None:
        (tmp_path / "rows.json").write_text(about)
    unit = Unit(step(reads=(str(tmp_path / "rows.csv"),)))
    with pytest.raises(DataError, match=r"rows.json: does not tell how rows.csv was measured"):
        unit.reads(tmp_path)
    assert why_old(unit, MEASURED, "abc1234") == OTHER_FILES


def test_a_changed_scenario_makes_a_figure_old(tmp_path: Path) -> None:
    """Scenarios are no code: only the steps that play one are measured again."""
    path = tmp_path / "loadgen" / "scenarios" / "calm.toml"
    path.parent.mkdir(parents=True)
    path.write_text("seed = 1")
    plays, unit = Unit(step(scenarios=("{part}",)), "calm"), Unit(step(scenarios=("c*",)))
    before = plays.reads(tmp_path)
    assert list(before) == ["loadgen/scenarios/calm.toml"]
    assert unit.reads(tmp_path) == before
    path.write_text("seed = 2")
    assert plays.reads(tmp_path) != before
    with pytest.raises(OffloadError, match="there is no scenario storm"):
        Unit(step(scenarios=("{part}",)), "storm").reads(tmp_path)


@pytest.mark.parametrize("unit", [next(step.units()) for one in SECTIONS for step in one.steps])
def test_a_step_that_plays_scenarios_reads_them(unit: Unit) -> None:
    """No step with `loadgen compare`, `checks` or `dataset` was forgotten."""
    plays = [one.split() for one in unit.commands() if one.split()[1] in ("compare", "checks", "dataset")]
    if plays:
        played = [find_scenario(word) for words in plays for word in words[2:3]]
        assert {path.resolve().relative_to(ROOT).as_posix() for path in played} <= unit.reads(ROOT).keys()


def test_a_step_whose_text_is_a_number_is_one_line(tmp_path: Path) -> None:
    """The file is named."""
    path = tmp_path / "steps.toml"
    path.write_text('[[section]]\npage = "s"\ntitle = "S"\n[[section.step]]\nname = "a"\nabout = 3\n')
    with pytest.raises(DataError, match=r"steps.toml: "):
        read_sections(path)


def test_a_file_is_old_if_code_or_command_changed() -> None:
    """Then, and only then, its step is measured again."""
    unit = Unit(step())
    assert why_old(unit, None, "abc1234") == "not measured"
    assert why_old(unit, MEASURED, "abc1234") == ""
    assert why_old(unit, MEASURED, "def5678") == "of commit abc1234"
    assert why_old(Unit(step(run=("ls",), parts=())), MEASURED, "abc1234") == "of other commands"


def test_a_file_survives_writing_and_reading(tmp_path: Path) -> None:
    """Reading gives what was written, and a broken file is named."""
    MEASURED.write(tmp_path / "new" / "speed.json")
    assert Measured.read(tmp_path / "new" / "speed.json") == MEASURED
    (tmp_path / "broken.json").write_text(json.dumps({"commit": "abc1234"}))
    with pytest.raises(DataError, match=r"broken.json: not a file of `make figures`"):
        Measured.read(tmp_path / "broken.json")


@pytest.mark.usefixtures("checkout")
def test_what_a_command_prints_is_kept_with_its_machine() -> None:
    """The output of all commands is, with the commands, the commit and the Python that ran them."""
    commands = ("python -c 'print(\"| a |\")'", "python -c 'print(2 + 2)'")
    measured = measure(Unit(step(run=commands, environment=sys.prefix)), "abc1234")
    assert list(measured.output) == ["| a |", "", "4"]
    assert tuple(measured.commands) == commands
    assert measured.commit == "abc1234"
    assert measured.machine["python"] == platform.python_version()
    assert measured.seconds >= 0


@pytest.mark.usefixtures("checkout")
def test_finished_runs_are_used_at_the_same_commit_only() -> None:
    """The folder of a step is emptied for another commit, for other commands, and if asked for."""
    code = (
        "from pathlib import Path; p = Path('{out}', 'runs'); "
        "p.write_text(said := p.exists() * '+' + 'run'); print(said)"
    )
    unit, other = (
        Unit(step(name="finished", run=(f'python -c "{code}{more}"',), environment=sys.prefix))
        for more in ("", ";")
    )
    first = measure(unit, "abc1234", again=True)
    assert list(first.output) == ["run"]
    assert list(measure(unit, "abc1234").output) == ["+run"]
    assert list(measure(unit, "def5678").output) == ["run"]
    assert list(measure(unit, "def5678", again=True).output) == ["run"]
    assert list(measure(other, "def5678").output) == ["run"]


def test_no_step_shares_its_folder() -> None:
    """Runs and pictures are in folders that belong to the step or part, so emptying one hurts no other."""
    assert [command for unit in UNITS for command in unit.step.run if "out/" in command] == []
    assert [one for unit in UNITS for one in unit.step.copies if not one.startswith("{out}/")] == []


@pytest.mark.usefixtures("checkout")
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("python -c 'raise SystemExit(\"no map\")'", "ended with exit code 1: no map"),
        ("python -c 'pass'", "nothing was printed"),
        ("no-such-program", "there is no program no-such-program"),
    ],
)
def test_a_command_that_fails_leaves_no_figures(command: str, said: str) -> None:
    """The step is not measured, and the error says why."""
    with pytest.raises(OffloadError, match=said):
        measure(Unit(step(run=(command,), environment=sys.prefix)), "abc1234")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--only", "decisions"], "--only: unknown step 'decisions'; did you mean 'decision'?"),
        (["--again", "checks-local/clam"], "did you mean 'checks-local/calm'?"),
        (["--only", "calls", "--again", "decision"], "--again: decision is not among those of --only"),
    ],
)
def test_a_wrong_name_is_one_line(flags: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It gives exit code 2."""
    assert main(flags) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
